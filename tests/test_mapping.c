/* Mapping by names: the skeletons people have, and what is refused. Expected joints are written
 * out by hand for each. */
#include "mocap_support.h"

#include <unistd.h>

typedef struct named_skeleton {
  const char *source;
  int joint_count;
  const char *const *joints;   /* "name<parent name": parents first */
  const char *const *expected; /* KG_ROLE_COUNT names, NULL: empty */
} named_skeleton;

/* clip of a tree given as "name<parent" lines, depth first */
static kg_clip *tree_clip(const char *const *lines, int count)
{
  table_joint table[64];
  static char names[64][64];
  assert_true(count <= 64);
  for (int j = 0; j < count; j++) {
    const char *arrow = strchr(lines[j], '<');
    snprintf(names[j], sizeof names[j], "%.*s", (int)(arrow - lines[j]), lines[j]);
    int parent = -1;
    for (int k = 0; k < j; k++) {
      parent = strcmp(names[k], arrow + 1) == 0 ? k : parent;
    }
    assert_int_equal(parent >= 0, j > 0);
    table[j] = (table_joint){names[j], parent, 0, 0.1, 0};
  }
  text_buffer text = {0};
  add_hierarchy(&text, table, count, 100.0, KG_UP_Y);
  text_add(&text, "MOTION\nFrames: 1\nFrame Time: 0.01\n");
  for (int c = 0; c < 3 + 3 * count; c++)
    text_add(&text, "0 ");
  kg_clip *clip = clip_of(text.at, text.length);
  text_free(&text);
  return clip;
}

/* clang-format off */
#define TREE(name, ...) static const char *const name[] = {__VA_ARGS__}
/* order of the expected names: pelvis, spine 3, neck 2, head, left arm 4, right arm 4, left leg 4,
 * right leg 4 */
TREE(cmu, "Hips<", "LHipJoint<Hips", "LeftUpLeg<LHipJoint", "LeftLeg<LeftUpLeg", "LeftFoot<LeftLeg",
     "LeftToeBase<LeftFoot", "RHipJoint<Hips", "RightUpLeg<RHipJoint", "RightLeg<RightUpLeg",
     "RightFoot<RightLeg", "RightToeBase<RightFoot", "LowerBack<Hips", "Spine<LowerBack",
     "Spine1<Spine", "Neck<Spine1", "Neck1<Neck", "Head<Neck1", "LeftShoulder<Spine1",
     "LeftArm<LeftShoulder", "LeftForeArm<LeftArm", "LeftHand<LeftForeArm",
     "LeftFingerBase<LeftHand", "LThumb<LeftHand", "RightShoulder<Spine1", "RightArm<RightShoulder",
     "RightForeArm<RightArm", "RightHand<RightForeArm");
TREE(cmu_roles, "Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head", "LeftShoulder",
     "LeftArm", "LeftForeArm", "LeftHand", "RightShoulder", "RightArm", "RightForeArm", "RightHand",
     "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "RightUpLeg", "RightLeg", "RightFoot",
     "RightToeBase");
TREE(asf, "root<", "lhipjoint<root", "lfemur<lhipjoint", "ltibia<lfemur", "lfoot<ltibia",
     "ltoes<lfoot", "rhipjoint<root", "rfemur<rhipjoint", "rtibia<rfemur", "rfoot<rtibia",
     "rtoes<rfoot", "lowerback<root", "upperback<lowerback", "thorax<upperback", "lowerneck<thorax",
     "upperneck<lowerneck", "head<upperneck", "lclavicle<thorax", "lhumerus<lclavicle",
     "lradius<lhumerus", "lwrist<lradius", "lhand<lwrist", "rclavicle<thorax", "rhumerus<rclavicle",
     "rradius<rhumerus", "rwrist<rradius", "rhand<rwrist");
TREE(asf_roles, "root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head",
     "lclavicle", "lhumerus", "lradius", "lwrist", "rclavicle", "rhumerus", "rradius", "rwrist",
     "lfemur", "ltibia", "lfoot", "ltoes", "rfemur", "rtibia", "rfoot", "rtoes");
TREE(mixamo, "mixamorig:Hips<", "mixamorig:Spine<mixamorig:Hips",
     "mixamorig:Spine1<mixamorig:Spine", "mixamorig:Spine2<mixamorig:Spine1",
     "mixamorig:Neck<mixamorig:Spine2", "mixamorig:Head<mixamorig:Neck",
     "mixamorig:HeadTop_End<mixamorig:Head", "mixamorig:LeftShoulder<mixamorig:Spine2",
     "mixamorig:LeftArm<mixamorig:LeftShoulder", "mixamorig:LeftForeArm<mixamorig:LeftArm",
     "mixamorig:LeftHand<mixamorig:LeftForeArm", "mixamorig:LeftHandThumb1<mixamorig:LeftHand",
     "mixamorig:RightShoulder<mixamorig:Spine2", "mixamorig:RightArm<mixamorig:RightShoulder",
     "mixamorig:RightForeArm<mixamorig:RightArm", "mixamorig:RightHand<mixamorig:RightForeArm",
     "mixamorig:LeftUpLeg<mixamorig:Hips", "mixamorig:LeftLeg<mixamorig:LeftUpLeg",
     "mixamorig:LeftFoot<mixamorig:LeftLeg", "mixamorig:LeftToeBase<mixamorig:LeftFoot",
     "mixamorig:RightUpLeg<mixamorig:Hips", "mixamorig:RightLeg<mixamorig:RightUpLeg",
     "mixamorig:RightFoot<mixamorig:RightLeg", "mixamorig:RightToeBase<mixamorig:RightFoot");
TREE(mixamo_roles, "mixamorig:Hips", "mixamorig:Spine", "mixamorig:Spine1", "mixamorig:Spine2",
     "mixamorig:Neck", NULL, "mixamorig:Head", "mixamorig:LeftShoulder", "mixamorig:LeftArm",
     "mixamorig:LeftForeArm", "mixamorig:LeftHand", "mixamorig:RightShoulder", "mixamorig:RightArm",
     "mixamorig:RightForeArm", "mixamorig:RightHand", "mixamorig:LeftUpLeg", "mixamorig:LeftLeg",
     "mixamorig:LeftFoot", "mixamorig:LeftToeBase", "mixamorig:RightUpLeg", "mixamorig:RightLeg",
     "mixamorig:RightFoot", "mixamorig:RightToeBase");
/* LAFAN1 and SNU s_003 */
TREE(lafan, "Hips<", "LeftUpLeg<Hips", "LeftLeg<LeftUpLeg", "LeftFoot<LeftLeg", "LeftToe<LeftFoot",
     "RightUpLeg<Hips", "RightLeg<RightUpLeg", "RightFoot<RightLeg", "RightToe<RightFoot",
     "Spine<Hips", "Spine1<Spine", "Spine2<Spine1", "Neck<Spine2", "Head<Neck",
     "LeftShoulder<Spine2", "LeftArm<LeftShoulder", "LeftForeArm<LeftArm", "LeftHand<LeftForeArm",
     "RightShoulder<Spine2", "RightArm<RightShoulder", "RightForeArm<RightArm",
     "RightHand<RightForeArm");
TREE(lafan_roles, "Hips", "Spine", "Spine1", "Spine2", "Neck", NULL, "Head", "LeftShoulder",
     "LeftArm", "LeftForeArm", "LeftHand", "RightShoulder", "RightArm", "RightForeArm", "RightHand",
     "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToe", "RightUpLeg", "RightLeg", "RightFoot",
     "RightToe");
TREE(snu, "Character1_Hips<", "Character1_Spine<Character1_Hips",
     "Character1_Spine1<Character1_Spine", "Character1_LeftShoulder<Character1_Spine1",
     "Character1_LeftArm<Character1_LeftShoulder", "Character1_LeftForeArm<Character1_LeftArm",
     "Character1_LeftHand<Character1_LeftForeArm", "L_Shoulder_RIGMESH<Character1_LeftShoulder",
     "Character1_RightShoulder<Character1_Spine1", "Character1_RightArm<Character1_RightShoulder",
     "Character1_RightForeArm<Character1_RightArm", "Character1_RightHand<Character1_RightForeArm",
     "Character1_Neck<Character1_Spine1", "Character1_Head<Character1_Neck",
     "Neck_RIGMESH<Character1_Neck", "Spine_RIGMESH<Character1_Spine",
     "Character1_RightUpLeg<Character1_Hips", "Character1_RightLeg<Character1_RightUpLeg",
     "Character1_RightFoot<Character1_RightLeg", "Character1_RightToeBase<Character1_RightFoot",
     "Character1_LeftUpLeg<Character1_Hips", "Character1_LeftLeg<Character1_LeftUpLeg",
     "Character1_LeftFoot<Character1_LeftLeg", "Character1_LeftToeBase<Character1_LeftFoot",
     "Pelvis_RIGMESH<Character1_Hips");
TREE(snu_roles, "Character1_Hips", "Character1_Spine", "Character1_Spine1", NULL,
     "Character1_Neck", NULL, "Character1_Head", "Character1_LeftShoulder", "Character1_LeftArm",
     "Character1_LeftForeArm", "Character1_LeftHand", "Character1_RightShoulder",
     "Character1_RightArm", "Character1_RightForeArm", "Character1_RightHand",
     "Character1_LeftUpLeg", "Character1_LeftLeg", "Character1_LeftFoot", "Character1_LeftToeBase",
     "Character1_RightUpLeg", "Character1_RightLeg", "Character1_RightFoot",
     "Character1_RightToeBase");
/* here LeftShoulder is the shoulder */
TREE(boxing, "Hips<", "Ab<Hips", "Chest<Ab", "Neck<Chest", "Head<Neck", "LeftCollar<Chest",
     "LeftShoulder<LeftCollar", "LeftElbow<LeftShoulder", "LeftWrist<LeftElbow",
     "RightCollar<Chest", "RightShoulder<RightCollar", "RightElbow<RightShoulder",
     "RightWrist<RightElbow", "LeftHip<Hips", "LeftKnee<LeftHip", "LeftAnkle<LeftKnee",
     "LeftToes<LeftAnkle", "RightHip<Hips", "RightKnee<RightHip", "RightAnkle<RightKnee",
     "RightToes<RightAnkle");
TREE(boxing_roles, "Hips", "Ab", "Chest", NULL, "Neck", NULL, "Head", "LeftCollar", "LeftShoulder",
     "LeftElbow", "LeftWrist", "RightCollar", "RightShoulder", "RightElbow", "RightWrist",
     "LeftHip", "LeftKnee", "LeftAnkle", "LeftToes", "RightHip", "RightKnee", "RightAnkle",
     "RightToes");
/* Xsens MVN export: four chest joints, three roles */
TREE(xsens, "Hips<", "Chest<Hips", "Chest2<Chest", "Chest3<Chest2", "Chest4<Chest3", "Neck<Chest4",
     "Head<Neck", "RightCollar<Chest4", "RightShoulder<RightCollar", "RightElbow<RightShoulder",
     "RightWrist<RightElbow", "LeftCollar<Chest4", "LeftShoulder<LeftCollar",
     "LeftElbow<LeftShoulder", "LeftWrist<LeftElbow", "RightHip<Hips", "RightKnee<RightHip",
     "RightAnkle<RightKnee", "RightToe<RightAnkle", "LeftHip<Hips", "LeftKnee<LeftHip",
     "LeftAnkle<LeftKnee", "LeftToe<LeftAnkle");
TREE(xsens_roles, "Hips", "Chest", "Chest3", "Chest4", "Neck", NULL, "Head", "LeftCollar",
     "LeftShoulder", "LeftElbow", "LeftWrist", "RightCollar", "RightShoulder", "RightElbow",
     "RightWrist", "LeftHip", "LeftKnee", "LeftAnkle", "LeftToe", "RightHip", "RightKnee",
     "RightAnkle", "RightToe");
TREE(segments, "Pelvis<", "L5<Pelvis", "L3<L5", "T12<L3", "T8<T12", "Neck<T8", "Head<Neck",
     "RightShoulder<T8", "RightUpperArm<RightShoulder", "RightForeArm<RightUpperArm",
     "RightHand<RightForeArm", "LeftShoulder<T8", "LeftUpperArm<LeftShoulder",
     "LeftForeArm<LeftUpperArm", "LeftHand<LeftForeArm", "RightUpperLeg<Pelvis",
     "RightLowerLeg<RightUpperLeg", "RightFoot<RightLowerLeg", "RightToe<RightFoot",
     "LeftUpperLeg<Pelvis", "LeftLowerLeg<LeftUpperLeg", "LeftFoot<LeftLowerLeg",
     "LeftToe<LeftFoot");
TREE(segments_roles, "Pelvis", "L5", "T12", "T8", "Neck", NULL, "Head", "LeftShoulder",
     "LeftUpperArm", "LeftForeArm", "LeftHand", "RightShoulder", "RightUpperArm", "RightForeArm",
     "RightHand", "LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToe", "RightUpperLeg",
     "RightLowerLeg", "RightFoot", "RightToe");
TREE(smpl, "Pelvis<", "L_Hip<Pelvis", "L_Knee<L_Hip", "L_Ankle<L_Knee", "L_Foot<L_Ankle",
     "R_Hip<Pelvis", "R_Knee<R_Hip", "R_Ankle<R_Knee", "R_Foot<R_Ankle", "Spine1<Pelvis",
     "Spine2<Spine1", "Spine3<Spine2", "Neck<Spine3", "Head<Neck", "L_Collar<Spine3",
     "L_Shoulder<L_Collar", "L_Elbow<L_Shoulder", "L_Wrist<L_Elbow", "R_Collar<Spine3",
     "R_Shoulder<R_Collar", "R_Elbow<R_Shoulder", "R_Wrist<R_Elbow");
TREE(smpl_roles, "Pelvis", "Spine1", "Spine2", "Spine3", "Neck", NULL, "Head", "L_Collar",
     "L_Shoulder", "L_Elbow", "L_Wrist", "R_Collar", "R_Shoulder", "R_Elbow", "R_Wrist", "L_Hip",
     "L_Knee", "L_Ankle", "L_Foot", "R_Hip", "R_Knee", "R_Ankle", "R_Foot");
TREE(biped, "Bip01<", "Bip01 Pelvis<Bip01", "Bip01 Spine<Bip01 Pelvis", "Bip01 Spine1<Bip01 Spine",
     "Bip01 Neck<Bip01 Spine1", "Bip01 Head<Bip01 Neck", "Bip01 L Clavicle<Bip01 Neck",
     "Bip01 L UpperArm<Bip01 L Clavicle", "Bip01 L Forearm<Bip01 L UpperArm",
     "Bip01 L Hand<Bip01 L Forearm", "Bip01 R Clavicle<Bip01 Neck",
     "Bip01 R UpperArm<Bip01 R Clavicle", "Bip01 R Forearm<Bip01 R UpperArm",
     "Bip01 R Hand<Bip01 R Forearm", "Bip01 L Thigh<Bip01 Pelvis", "Bip01 L Calf<Bip01 L Thigh",
     "Bip01 L Foot<Bip01 L Calf", "Bip01 L Toe0<Bip01 L Foot", "Bip01 R Thigh<Bip01 Pelvis",
     "Bip01 R Calf<Bip01 R Thigh", "Bip01 R Foot<Bip01 R Calf", "Bip01 R Toe0<Bip01 R Foot");
TREE(biped_roles, "Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", NULL, "Bip01 Neck", NULL,
     "Bip01 Head", "Bip01 L Clavicle", "Bip01 L UpperArm", "Bip01 L Forearm", "Bip01 L Hand",
     "Bip01 R Clavicle", "Bip01 R UpperArm", "Bip01 R Forearm", "Bip01 R Hand", "Bip01 L Thigh",
     "Bip01 L Calf", "Bip01 L Foot", "Bip01 L Toe0", "Bip01 R Thigh", "Bip01 R Calf",
     "Bip01 R Foot", "Bip01 R Toe0");
TREE(unreal, "root<", "pelvis<root", "spine_01<pelvis", "spine_02<spine_01", "spine_03<spine_02",
     "neck_01<spine_03", "head<neck_01", "clavicle_l<spine_03", "upperarm_l<clavicle_l",
     "lowerarm_l<upperarm_l", "hand_l<lowerarm_l", "clavicle_r<spine_03", "upperarm_r<clavicle_r",
     "lowerarm_r<upperarm_r", "hand_r<lowerarm_r", "thigh_l<pelvis", "calf_l<thigh_l",
     "foot_l<calf_l", "ball_l<foot_l", "thigh_r<pelvis", "calf_r<thigh_r", "foot_r<calf_r",
     "ball_r<foot_r");
TREE(unreal_roles, "pelvis", "spine_01", "spine_02", "spine_03", "neck_01", NULL, "head",
     "clavicle_l", "upperarm_l", "lowerarm_l", "hand_l", "clavicle_r", "upperarm_r", "lowerarm_r",
     "hand_r", "thigh_l", "calf_l", "foot_l", "ball_l", "thigh_r", "calf_r", "foot_r", "ball_r");
TREE(poser, "hip<", "abdomen<hip", "chest<abdomen", "neck<chest", "head<neck", "leftEye<head",
     "lCollar<chest", "lShldr<lCollar", "lForeArm<lShldr", "lHand<lForeArm", "rCollar<chest",
     "rShldr<rCollar", "rForeArm<rShldr", "rHand<rForeArm", "lThigh<hip", "lShin<lThigh",
     "lFoot<lShin", "rThigh<hip", "rShin<rThigh", "rFoot<rShin");
TREE(poser_roles, "hip", "abdomen", "chest", NULL, "neck", NULL, "head", "lCollar", "lShldr",
     "lForeArm", "lHand", "rCollar", "rShldr", "rForeArm", "rHand", "lThigh", "lShin", "lFoot",
     NULL, "rThigh", "rShin", "rFoot", NULL);
TREE(unity, "Hips<", "Spine<Hips", "Chest<Spine", "UpperChest<Chest", "Neck<UpperChest",
     "Head<Neck", "LeftShoulder<UpperChest", "LeftUpperArm<LeftShoulder",
     "LeftLowerArm<LeftUpperArm", "LeftHand<LeftLowerArm", "RightShoulder<UpperChest",
     "RightUpperArm<RightShoulder", "RightLowerArm<RightUpperArm", "RightHand<RightLowerArm",
     "LeftUpperLeg<Hips", "LeftLowerLeg<LeftUpperLeg", "LeftFoot<LeftLowerLeg", "LeftToes<LeftFoot",
     "RightUpperLeg<Hips", "RightLowerLeg<RightUpperLeg", "RightFoot<RightLowerLeg",
     "RightToes<RightFoot");
TREE(unity_roles, "Hips", "Spine", "Chest", "UpperChest", "Neck", NULL, "Head", "LeftShoulder",
     "LeftUpperArm", "LeftLowerArm", "LeftHand", "RightShoulder", "RightUpperArm", "RightLowerArm",
     "RightHand", "LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToes", "RightUpperLeg",
     "RightLowerLeg", "RightFoot", "RightToes");
TREE(generic, "HIPS<", "spine<HIPS", "head<spine", "l_shoulder<spine", "l_elbow<l_shoulder",
     "l_wrist<l_elbow", "r_shoulder<spine", "r_elbow<r_shoulder", "r_wrist<r_elbow", "l_hip<HIPS",
     "l_knee<l_hip", "l_ankle<l_knee", "r_hip<HIPS", "r_knee<r_hip", "r_ankle<r_knee");
TREE(generic_roles, "HIPS", "spine", NULL, NULL, NULL, NULL, "head", NULL, "l_shoulder", "l_elbow",
     "l_wrist", NULL, "r_shoulder", "r_elbow", "r_wrist", "l_hip", "l_knee", "l_ankle", NULL,
     "r_hip", "r_knee", "r_ankle", NULL);
#define SKELETON(source, tree) {source, (int)KG_COUNT_OF(tree), tree, tree##_roles}
static const named_skeleton skeletons[] = {
  SKELETON("CMU", cmu), SKELETON("ASF", asf), SKELETON("MotionBuilder/Mixamo", mixamo),
  SKELETON("MotionBuilder/Mixamo", lafan), SKELETON("SNU", snu), SKELETON("Xsens", boxing),
  SKELETON("Xsens", xsens), SKELETON("Xsens segments", segments), SKELETON("SMPL", smpl),
  SKELETON("Biped", biped), SKELETON("Unreal", unreal), SKELETON("Poser/DAZ", poser),
  SKELETON("Unity/VRM", unity), SKELETON("Xsens", generic),
};
/* clang-format on */

static void assert_roles(const kg_clip *clip, const kg_mapping *mapping,
                         const char *const *expected)
{
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    const int joint = mapping->joint_of_role[r];
    const char *name = joint >= 0 ? clip->joints[joint].name : "(none)";
    if (strcmp(name, expected[r] ? expected[r] : "(none)") != 0) {
      fail_msg("%s: %s is %s, expected %s", mapping->source, kg_role_name((kg_role)r), name,
               expected[r] ? expected[r] : "(none)");
    }
  }
}

static void known_skeletons_get_their_roles(void **state)
{
  (void)state;
  for (size_t i = 0; i < KG_COUNT_OF(skeletons); i++) {
    const named_skeleton *s = &skeletons[i];
    kg_clip *clip = tree_clip(s->joints, s->joint_count);
    kg_mapping mapping;
    kg_error error = {.text = ""};
    if (kg_mapping_find(&mapping, clip, NULL, &error) != KG_OK) {
      fail_msg("%s: %s", s->source, error.text);
    }
    assert_roles(clip, &mapping, s->expected);
    assert_string_equal(mapping.source, s->source);
    kg_clip_destroy(clip);
  }
}

static void roles_form_the_canonical_tree(void **state)
{
  (void)state;
  assert_int_equal(KG_ROLE_COUNT, 23);
  assert_string_equal(kg_role_name(KG_ROLE_L_CLAVICLE), "l_clavicle");
  assert_null(kg_role_name(KG_ROLE_COUNT));
  assert_null(kg_role_name((kg_role)-1));
  assert_int_equal(kg_role_parent(KG_ROLE_PELVIS), -1);
  assert_int_equal(kg_role_parent(KG_ROLE_R_CLAVICLE), KG_ROLE_SPINE3);
  for (int r = 1; r < KG_ROLE_COUNT; r++) {
    assert_in_range(kg_role_parent((kg_role)r), 0, r - 1);
  }
}

static void missing_roles_are_named(void **state)
{
  (void)state;
  TREE(chair, "seat<", "back<seat", "left leg<seat", "right leg<seat");
  kg_clip *clip = tree_clip(chair, 4);
  kg_mapping mapping;
  kg_error error;
  assert_int_equal(kg_mapping_find(&mapping, clip, NULL, &error), KG_ERR_UNMAPPED);
  assert_non_null(strstr(error.text, "pelvis, head, l_shoulder"));
  assert_non_null(strstr(error.text, "spine1"));
  assert_non_null(strstr(error.text, "--map FILE"));
  assert_non_null(strstr(error.text, "'role = joint name'"));
  assert_null(strstr(error.text, "l_knee,")); /* 'left leg' was placed */
  assert_string_equal(error.path, "test.bvh");
  kg_clip_destroy(clip);
}

static const char *write_map(const char *text)
{
  const char *path = KG_TEST_SCRATCH "/roles.map";
  FILE *file = fopen(path, "wb");
  assert_non_null(file);
  fputs(text, file);
  fclose(file);
  return path;
}

static void a_map_file_overrides_the_names(void **state)
{
  (void)state;
  kg_clip *clip = tree_clip(generic, (int)KG_COUNT_OF(generic));
  kg_mapping mapping;
  const char *path =
    write_map("# my rig\r\n\r\n  head = spine # a comment\nSPINE1 = \n spine3=spine\nl_wrist =\n"
              "head=HEAD\nr_toe = R_ankle");
  kg_error error = {.text = ""};
  /* r_toe on the ankle's own joint: not below it */
  assert_int_equal(kg_mapping_find(&mapping, clip, path, &error), KG_ERR_UNMAPPED);
  assert_non_null(strstr(error.text, "r_toe is joint 'r_ankle', which is not below 'r_ankle'"));
  path = write_map("SPINE1 =\nspine3=spine\nl_wrist = # none\nhead = HEAD");
  assert_int_equal(kg_mapping_find(&mapping, clip, path, &error), KG_OK);
  assert_int_equal(mapping.joint_of_role[KG_ROLE_SPINE1], -1);
  assert_int_equal(mapping.joint_of_role[KG_ROLE_SPINE3], kg_clip_find(clip, "spine"));
  assert_int_equal(mapping.joint_of_role[KG_ROLE_L_WRIST], -1);
  assert_int_equal(mapping.joint_of_role[KG_ROLE_HEAD], kg_clip_find(clip, "head"));
  assert_memory_equal(mapping.source, "file ", 5);
  static const struct {
    const char *text;
    kg_status status;
    long line, column;
    const char *part;
  } bad[] = {
    {"head = head\nhat = head\n", KG_ERR_FORMAT, 2, 1, "'hat'"},
    {"head\n", KG_ERR_FORMAT, 1, 5, "'='"},
    {"# x\nhead = hut\n", KG_ERR_FORMAT, 2, 8, "'hut'"},
    {"head =\n", KG_ERR_UNMAPPED, 0, 0, "no joint found for head"},
    {"l_knee = r_knee", KG_ERR_UNMAPPED, 0, 0, "not below 'l_hip'"},
  };
  for (size_t i = 0; i < KG_COUNT_OF(bad); i++) {
    path = write_map(bad[i].text);
    assert_int_equal(kg_mapping_find(&mapping, clip, path, &error), bad[i].status);
    assert_non_null(strstr(error.text, bad[i].part));
    assert_int_equal(error.line, bad[i].line);
    assert_int_equal(error.column, bad[i].column);
  }
  unlink(path);
  assert_int_equal(kg_mapping_find(&mapping, clip, path, &error), KG_ERR_READ);
  assert_string_equal(error.path, path);
  kg_clip_destroy(clip);
}

static void a_joint_elsewhere_in_the_tree_does_not_count(void **state)
{
  (void)state;
  /* a prop with the name of a hand comes first, and must not be the hand */
  TREE(prop, "HIPS<", "LeftHand<HIPS", "Spine<HIPS", "Head<Spine", "LeftArm<Spine",
       "LeftForeArm<LeftArm", "leftHand<LeftForeArm", "RightArm<Spine", "RightForeArm<RightArm",
       "LeftUpLeg<HIPS", "LeftLeg<LeftUpLeg", "LeftFoot<LeftLeg", "RightUpLeg<HIPS",
       "RightLeg<RightUpLeg", "RightFoot<RightLeg");
  kg_clip *clip = tree_clip(prop, (int)KG_COUNT_OF(prop));
  kg_mapping mapping;
  assert_int_equal(kg_mapping_find(&mapping, clip, NULL, NULL), KG_OK);
  assert_int_equal(mapping.joint_of_role[KG_ROLE_L_WRIST], kg_clip_find(clip, "leftHand"));
  assert_int_equal(mapping.joint_of_role[KG_ROLE_R_WRIST], -1);
  assert_string_equal(mapping.source, "MotionBuilder/Mixamo"); /* CMU places as many: a tie */
  /* in a map file the exact name goes before another case */
  const char *path = write_map("l_wrist = leftHand");
  assert_int_equal(kg_mapping_find(&mapping, clip, path, NULL), KG_OK);
  assert_int_equal(mapping.joint_of_role[KG_ROLE_L_WRIST], kg_clip_find(clip, "leftHand"));
  unlink(path);
  kg_clip_destroy(clip);
}

static void every_capture_is_mapped(void **state)
{
  (void)state;
  static const struct {
    const char *name, *source;
    int roles;
  } files[] = {
    {"basketball/cmu_06_02.bvh", "CMU", 23},
    {"basketball/snu_s_003_6_1.bvh", "MotionBuilder/Mixamo", 22},
    {"gymnastics/snu_backflip.bvh", "SNU", 21},
    {"gymnastics/snu_pirouette.bvh", "SNU", 21},
    {"gymnastics/cmu_05_07.amc", "ASF", 23},
    {"track/cmu_16_03.amc", "ASF", 23},
  };
  for (size_t i = 0; i < KG_COUNT_OF(files); i++) {
    char path[1024];
    FILE *file = open_shared(files[i].name, path, sizeof path);
    if (!file) {
      print_message("skipped: no capture at %s\n", path);
      skip();
    }
    fclose(file);
    const kg_clip_def def = kg_clip_default_def();
    kg_clip *clip;
    kg_mapping mapping;
    assert_int_equal(kg_clip_read(&clip, path, &def, NULL), KG_OK);
    assert_int_equal(kg_mapping_find(&mapping, clip, NULL, NULL), KG_OK);
    assert_string_equal(mapping.source, files[i].source);
    int roles = 0;
    for (int r = 0; r < KG_ROLE_COUNT; r++) {
      roles += mapping.joint_of_role[r] >= 0;
    }
    assert_int_equal(roles, files[i].roles);
    kg_clip_destroy(clip);
  }
}

int main(void)
{
  const struct CMUnitTest tests[] = {
    cmocka_unit_test(known_skeletons_get_their_roles),
    cmocka_unit_test(roles_form_the_canonical_tree),
    cmocka_unit_test(missing_roles_are_named),
    cmocka_unit_test(a_map_file_overrides_the_names),
    cmocka_unit_test(a_joint_elsewhere_in_the_tree_does_not_count),
    cmocka_unit_test(every_capture_is_mapped),
  };
  return cmocka_run_group_tests_name("mapping", tests, NULL, NULL);
}

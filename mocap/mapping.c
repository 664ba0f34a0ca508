/* Which joint plays which of the 23 roles, by names.
 *
 * Names are compared without namespace ("mixamorig:"), known prefix ("Character1_", "Bip01 "),
 * case, blanks and punctuation. A row of the table below is one naming convention; the row that
 * places the most roles wins, the earlier one on a tie. New skeletons are a new row. */
#include "mocap/mocap.h"

#include "base/read_file.h"

#include <ctype.h>
#include <stdio.h>
#include <string.h>

const char *kg_role_name(kg_role role)
{
  static const char *const names[] = {
#define KG_ROLE_TEXT(id, text, parent) text,
    KG_ROLE_LIST(KG_ROLE_TEXT)
#undef KG_ROLE_TEXT
  };
  return (int)role >= 0 && role < KG_ROLE_COUNT ? names[role] : NULL;
}

int kg_role_parent(kg_role role)
{
  static const int parents[] = {
#define KG_ROLE_ABOVE(id, text, parent) parent,
    KG_ROLE_LIST(KG_ROLE_ABOVE)
#undef KG_ROLE_ABOVE
  };
  return (int)role >= 0 && role < KG_ROLE_COUNT ? parents[role] : -1;
}

/* Alternatives are separated by '|', the preferred one first. spine and neck list the joints from
 * the bottom up, and all that exist are used. The names of limbs stand without their side. */
typedef struct convention {
  const char *name, *pelvis, *spine, *neck, *clavicle, *shoulder, *elbow, *wrist, *hip, *knee,
    *ankle, *toe;
} convention;

/* clang-format off */
static const convention conventions[] = {
  {"MotionBuilder/Mixamo", "hips|hip|pelvis|root", "spine|spine1|spine2|spine3|spine4",
   "neck|neck1|neck2", "shoulder|collar|clavicle", "arm|uparm", "forearm", "hand|wrist",
   "upleg|thigh", "leg|lowleg|shin", "foot|ankle", "toebase|toe|toes"},
  {"CMU", "hips", "lowerback|spine|spine1", "neck|neck1", "shoulder", "arm", "forearm", "hand",
   "upleg", "leg", "foot", "toebase"},
  {"ASF", "root", "lowerback|upperback|thorax", "lowerneck|upperneck", "clavicle", "humerus",
   "radius", "wrist", "femur", "tibia", "foot", "toes"},
  {"Xsens", "hips|pelvis|hip|root",
   "ab|abdomen|spine|spine1|chest|chest1|chest2|chest3|chest4|upperchest", "neck|neck1",
   "collar|clavicle", "shoulder", "elbow", "wrist|hand", "hip", "knee", "ankle|foot",
   "toes|toe|toebase"},
  {"Xsens segments", "pelvis", "l5|l3|t12|t8", "neck", "shoulder", "upperarm", "forearm", "hand",
   "upperleg", "lowerleg", "foot", "toe"},
  {"SMPL", "pelvis|hips|root", "spine1|spine2|spine3", "neck", "collar|clavicle", "shoulder",
   "elbow", "wrist", "hip", "knee", "ankle", "foot|toe"},
  {"Poser/DAZ", "hip|hips|pelvis",
   "abdomen|abdomenlower|abdomen2|abdomenupper|chest|chestlower|chestupper",
   "neck|necklower|neckupper", "collar", "shldr|shldrbend|shoulder", "forearm|forearmbend", "hand",
   "thigh|thighbend", "shin", "foot", "toe|toes|toebase"},
  {"Biped", "pelvis", "spine|spine1|spine2|spine3|spine4", "neck|neck1", "clavicle", "upperarm",
   "forearm", "hand", "thigh", "calf", "foot", "toe0|toebase|toe"},
  {"Unreal", "pelvis", "spine01|spine02|spine03|spine04|spine05", "neck01|neck02|neck", "clavicle",
   "upperarm", "lowerarm", "hand", "thigh", "calf", "foot", "ball"},
  {"Unity/VRM", "hips", "spine|chest|upperchest", "neck", "shoulder", "upperarm", "lowerarm",
   "hand", "upperleg", "lowerleg", "foot", "toes|toe|toebase"},
};
/* clang-format on */

static const char *const known_prefixes[] = {"character", "mixamorig", "bip", "ccbase",
                                             "valvebiped"};

enum { NAME_SIZE = 64 };
typedef char plain_name[NAME_SIZE];

/* ---- names ----------------------------------------------------------------------------------- */

static void drop_prefix(char *plain)
{
  for (size_t i = 0; i < KG_COUNT_OF(known_prefixes); i++) {
    size_t n = strlen(known_prefixes[i]);
    if (strncmp(plain, known_prefixes[i], n) == 0) {
      n += strspn(plain + n, "0123456789");
      if (plain[n] != '\0') {
        memmove(plain, plain + n, strlen(plain + n) + 1);
      }
    }
  }
}

/* lower case letters and digits, after the last ':' or '|' */
static void make_plain(plain_name plain, const char *name)
{
  for (const char *p = name; *p != '\0'; p++) {
    if ((*p == ':' || *p == '|') && p[1] != '\0') {
      name = p + 1;
    }
  }
  size_t n = 0;
  for (; *name != '\0' && n < NAME_SIZE - 1; name++) {
    const char c = *name;
    if (c >= 'A' && c <= 'Z') {
      plain[n++] = (char)(c - 'A' + 'a');
    } else if ((c >= 'a' && c <= 'z') || (c >= '0' && c <= '9')) {
      plain[n++] = c;
    }
  }
  plain[n] = '\0';
  drop_prefix(plain);
}

/* side: "", "left" or "right"; that word or its first letter may stand before or after the name */
static bool matches(const char *plain, const char *side, const char *name, size_t length)
{
  const size_t whole = strlen(side), shortened = whole > 0;
  const size_t n = strlen(plain);
  for (int form = 0; form < 2; form++) {
    const size_t s = form == 0 ? whole : shortened;
    if (n == s + length &&
        ((strncmp(plain, side, s) == 0 && memcmp(plain + s, name, length) == 0) ||
         (memcmp(plain, name, length) == 0 && strncmp(plain + length, side, s) == 0))) {
      return true;
    }
  }
  return false;
}

/* ---- placing roles ---------------------------------------------------------------------------- */

typedef struct search {
  const kg_clip *clip;
  const plain_name *names;
  kg_mapping *mapping;
} search;

static bool descends(const kg_clip *clip, int joint, int ancestor)
{
  for (joint = clip->joints[joint].parent; joint >= 0; joint = clip->joints[joint].parent) {
    if (joint == ancestor) {
      return true;
    }
  }
  return false;
}

/* joint of the nearest mapped role above, -1 when there is none */
static int mapped_above(const kg_mapping *mapping, kg_role role)
{
  for (int r = kg_role_parent(role); r >= 0; r = kg_role_parent((kg_role)r)) {
    if (mapping->joint_of_role[r] >= 0) {
      return mapping->joint_of_role[r];
    }
  }
  return -1;
}

/* first joint with this name below `above` (-1: anywhere), or -1 */
static int find_below(const search *s, const char *side, const char *name, size_t length, int above)
{
  for (int j = 0; j < s->clip->joint_count; j++) {
    if (matches(s->names[j], side, name, length) && (above < 0 || descends(s->clip, j, above))) {
      return j;
    }
  }
  return -1;
}

static const char *next_alternative(const char **list, size_t *length)
{
  const char *start = *list;
  if (*start == '\0') {
    return NULL;
  }
  *length = strcspn(start, "|");
  *list = start + *length + (start[*length] == '|');
  return start;
}

static void place(const search *s, kg_role role, const char *side, const char *alternatives)
{
  const int above = mapped_above(s->mapping, role);
  size_t length;
  const char *name;
  while ((name = next_alternative(&alternatives, &length)) != NULL) {
    const int joint = find_below(s, side, name, length, above);
    if (joint >= 0) {
      s->mapping->joint_of_role[role] = joint;
      return;
    }
  }
}

/* All joints of the list, each below the one before; when there are more than roles, the first,
 * the last and those evenly between. */
static void place_chain(const search *s, kg_role first, int roles, const char *alternatives)
{
  int found[16], count = 0;
  int above = mapped_above(s->mapping, first);
  size_t length;
  const char *name;
  while ((name = next_alternative(&alternatives, &length)) != NULL && count < 16) {
    const int joint = find_below(s, "", name, length, above);
    if (joint >= 0) {
      found[count++] = joint;
      above = joint;
    }
  }
  for (int k = 0; k < roles && k < count; k++) {
    const int pick = count > roles ? (k * (count - 1) + (roles - 1) / 2) / (roles - 1) : k;
    s->mapping->joint_of_role[(int)first + k] = found[pick];
  }
}

static int try_convention(const search *s, const convention *c)
{
  static const char *const sides[] = {"left", "right"};
  const kg_role arm[] = {KG_ROLE_L_CLAVICLE, KG_ROLE_R_CLAVICLE};
  const kg_role leg[] = {KG_ROLE_L_HIP, KG_ROLE_R_HIP};
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    s->mapping->joint_of_role[r] = -1;
  }
  place(s, KG_ROLE_PELVIS, "", c->pelvis);
  place_chain(s, KG_ROLE_SPINE1, 3, c->spine);
  place_chain(s, KG_ROLE_NECK1, 2, c->neck);
  place(s, KG_ROLE_HEAD, "", "head");
  for (int i = 0; i < 2; i++) {
    const char *const arm_names[] = {c->clavicle, c->shoulder, c->elbow, c->wrist};
    const char *const leg_names[] = {c->hip, c->knee, c->ankle, c->toe};
    for (int k = 0; k < 4; k++) {
      place(s, (kg_role)((int)arm[i] + k), sides[i], arm_names[k]);
      place(s, (kg_role)((int)leg[i] + k), sides[i], leg_names[k]);
    }
  }
  int placed = 0;
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    placed += s->mapping->joint_of_role[r] >= 0;
  }
  return placed;
}

static void find_by_names(kg_mapping *mapping, const kg_clip *clip, const plain_name *names)
{
  int most = -1;
  for (size_t i = 0; i < KG_COUNT_OF(conventions); i++) {
    kg_mapping attempt = {{0}, ""};
    const search s = {clip, names, &attempt};
    const int placed = try_convention(&s, &conventions[i]);
    if (placed > most) {
      most = placed;
      *mapping = attempt;
      snprintf(mapping->source, sizeof mapping->source, "%s", conventions[i].name);
    }
  }
  const int pelvis = mapping->joint_of_role[KG_ROLE_PELVIS];
  if (pelvis >= 0 && strncmp(clip->joints[pelvis].name, "Character1_", 11) == 0) {
    snprintf(mapping->source, sizeof mapping->source, "SNU");
  }
}

/* ---- the map file ----------------------------------------------------------------------------- */

static int find_role(kg_word word)
{
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    if (kg_word_is(word, kg_role_name((kg_role)r))) {
      return r;
    }
  }
  return -1;
}

/* exact name first, then without regard to case */
static int find_joint(const kg_clip *clip, kg_word word)
{
  int found = -1;
  for (int j = clip->joint_count - 1; j >= 0; j--) {
    const char *name = clip->joints[j].name;
    if (strlen(name) == word.length && memcmp(name, word.start, word.length) == 0) {
      return j;
    }
    found = kg_word_is(word, name) ? j : found;
  }
  return found;
}

/* One line "role = joint name"; an empty name leaves the role empty. */
static kg_status read_map_line(kg_mapping *mapping, const kg_clip *clip, kg_text *text,
                               kg_error *error)
{
  const kg_text at = *text;
  const int role = find_role(kg_text_rest(text, '='));
  if (role < 0) {
    return kg_text_fail(&at, error, "a role such as pelvis, spine1 or l_knee, then '='");
  }
  if (kg_text_at_line_end(text)) {
    return kg_text_fail(text, error, "'=' and the name of a joint");
  }
  text->at++;
  kg_text_skip_spaces(text);
  const kg_text name_at = *text;
  const kg_word name = kg_text_rest(text, '#');
  const int joint = name.length > 0 ? find_joint(clip, name) : -1;
  if (name.length > 0 && joint < 0) {
    return kg_text_fail(&name_at, error, "the name of a joint of the clip");
  }
  mapping->joint_of_role[role] = joint;
  return KG_OK;
}

static kg_status read_map(kg_mapping *mapping, const kg_clip *clip, const char *path,
                          kg_arena *scratch, kg_error *error)
{
  char *content;
  size_t length;
  kg_status status = kg_read_file(&content, &length, scratch, path, error);
  if (status != KG_OK) {
    return status;
  }
  kg_text text = kg_text_make(content, length, path);
  for (kg_text_skip_blank(&text); status == KG_OK && !kg_text_at_end(&text);
       kg_text_skip_blank(&text)) {
    if (*text.at != '#') {
      status = read_map_line(mapping, clip, &text, error);
    }
    kg_text_skip_line(&text);
  }
  const size_t n = strlen(path), room = sizeof mapping->source - sizeof "file ";
  snprintf(mapping->source, sizeof mapping->source, "file %s", path + (n > room ? n - room : 0));
  return status;
}

/* ---- the check -------------------------------------------------------------------------------- */

typedef struct role_list {
  char text[256];
  size_t length;
} role_list;

static void add_to_list(role_list *list, const char *name)
{
  const int n = snprintf(list->text + list->length, sizeof list->text - list->length, "%s%s",
                         list->length > 0 ? ", " : "", name);
  list->length += n > 0 && (size_t)n < sizeof list->text - list->length ? (size_t)n : 0;
}

static bool is_required(kg_role role)
{
  switch (role) {
    case KG_ROLE_PELVIS:
    case KG_ROLE_HEAD:
    case KG_ROLE_L_SHOULDER:
    case KG_ROLE_R_SHOULDER:
    case KG_ROLE_L_ELBOW:
    case KG_ROLE_R_ELBOW:
    case KG_ROLE_L_HIP:
    case KG_ROLE_R_HIP:
    case KG_ROLE_L_KNEE:
    case KG_ROLE_R_KNEE:
    case KG_ROLE_L_ANKLE:
    case KG_ROLE_R_ANKLE:
      return true;
    default:
      return false;
  }
}

static kg_status check(const kg_mapping *mapping, const kg_clip *clip, kg_error *error)
{
  static const char *const remedy =
    "write lines 'role = joint name' into a file and give it with --map FILE";
  const int *joint = mapping->joint_of_role;
  role_list missing = {"", 0};
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    if (joint[r] < 0 && is_required((kg_role)r)) {
      add_to_list(&missing, kg_role_name((kg_role)r));
    }
  }
  if (joint[KG_ROLE_SPINE1] < 0 && joint[KG_ROLE_SPINE2] < 0 && joint[KG_ROLE_SPINE3] < 0) {
    add_to_list(&missing, "spine1 (or spine2, spine3)");
  }
  if (missing.length > 0) {
    return kg_fail(error, KG_ERR_UNMAPPED, clip->source.path, 0, 0,
                   "no joint found for %s among the skeleton's %d joints; %s", missing.text,
                   clip->joint_count, remedy);
  }
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    const int above = mapped_above(mapping, (kg_role)r);
    if (joint[r] >= 0 && above >= 0 && !descends(clip, joint[r], above)) {
      return kg_fail(error, KG_ERR_UNMAPPED, clip->source.path, 0, 0,
                     "%s is joint '%.60s', which is not below '%.60s', the joint of the role "
                     "above; %s",
                     kg_role_name((kg_role)r), clip->joints[joint[r]].name,
                     clip->joints[above].name, remedy);
    }
  }
  return KG_OK;
}

kg_status kg_mapping_find(kg_mapping *mapping, const kg_clip *clip, const char *map_path,
                          kg_error *error)
{
  kg_arena scratch;
  kg_arena_init(&scratch, clip->allocator);
  for (int r = 0; r < KG_ROLE_COUNT; r++) {
    mapping->joint_of_role[r] = -1;
  }
  plain_name *names = KG_ARENA_ARRAY(&scratch, plain_name, clip->joint_count);
  kg_status status = KG_OK;
  if (names) {
    for (int j = 0; j < clip->joint_count; j++) {
      make_plain(names[j], clip->joints[j].name);
    }
    find_by_names(mapping, clip, (const plain_name *)names);
  } else {
    status = kg_fail(error, KG_ERR_NO_MEMORY, "", 0, 0, "not enough memory for the mapping");
  }
  if (status == KG_OK && map_path) {
    status = read_map(mapping, clip, map_path, &scratch, error);
  }
  if (status == KG_OK) {
    status = check(mapping, clip, error);
  }
  kg_arena_release(&scratch);
  return status;
}

/* Body states from a clip's frames and back.
 *
 * A segment's rotation relative to its parent segment is the product of the local rotations of the
 * clip's joints on the way from the parent segment's joint down to its own. */
#include "physics/physics.h"

static kg_quat local_rotation(const kg_clip *clip, int frame, int joint)
{
  return clip->rotations[(ptrdiff_t)frame * clip->joint_count + joint];
}

static kg_vec3 local_translation(const kg_clip *clip, int frame, int joint)
{
  return clip->translations[(ptrdiff_t)frame * clip->joint_count + joint];
}

/* Pose of a joint relative to an ancestor's frame (-1: the world). */
static kg_quat pose_relative(const kg_clip *clip, int frame, int joint, int ancestor,
                             kg_vec3 *position)
{
  kg_quat R = kg_quat_identity();
  kg_vec3 p = {0.0, 0.0, 0.0};
  for (int j = joint; j != ancestor && j >= 0; j = clip->joints[j].parent) {
    const kg_quat r = local_rotation(clip, frame, j);
    p = kg_vec3_add(local_translation(clip, frame, j), kg_quat_rotate(r, p));
    R = kg_quat_mul(r, R);
  }
  *position = p;
  return R;
}

static int parent_joint(const kg_body *body, int segment)
{
  const int parent = body->segments[segment].parent;
  return parent < 0 ? -1 : body->segments[parent].joint;
}

void kg_body_state_from_clip(const kg_body *body, const kg_clip *clip, int frame, double *q,
                             const double *q_previous)
{
  KG_ASSERT(frame >= 0 && frame < clip->frame_count);
  for (int i = 0; i < body->segment_count; i++) {
    kg_vec3 p;
    kg_quat r = kg_quat_normalized(
      pose_relative(clip, frame, body->segments[i].joint, parent_joint(body, i), &p));
    if (q_previous && kg_quat_dot(r, kg_state_quat(q_previous, i)) < 0.0) {
      r = kg_quat_make(-r.w, -r.x, -r.y, -r.z);
    }
    if (i == 0) {
      kg_store3(q, p);
    }
    kg_state_set_quat(q, i, r);
  }
}

/* A rotation that is already there is left alone, and with it the channel values as captured. */
static void set_rotation_if_new(kg_clip *clip, int frame, int joint, kg_quat r, int previous_frame)
{
  const kg_quat turn = kg_quat_mul(kg_quat_conj(local_rotation(clip, frame, joint)), r);
  if (!(kg_vec3_norm(kg_quat_log(turn)) <= 1e-13)) {
    kg_clip_set_rotation(clip, frame, joint, r, previous_frame);
  }
}

/* The joint, itself or the nearest above, whose translation is a channel of the file; -1: none. */
static int moving_joint(const kg_clip *clip, int joint)
{
  for (int j = joint; j >= 0; j = clip->joints[j].parent) {
    for (int c = 0; c < clip->joints[j].channel_count; c++) {
      if (clip->joints[j].channels[c] <= KG_CHANNEL_Z_POSITION) {
        return j;
      }
    }
  }
  return -1;
}

/* Moves the joint to world position p by the translation of `mover`, one of its ancestors or
 * itself: p = P + A (t + r o), with P, A the pose of the mover's parent and o the offset below. */
static void place_joint(kg_clip *clip, int frame, int joint, int mover, kg_vec3 p)
{
  kg_vec3 P, o;
  const kg_quat A = pose_relative(clip, frame, clip->joints[mover].parent, -1, &P);
  (void)pose_relative(clip, frame, joint, mover, &o);
  const kg_vec3 below = kg_quat_rotate(local_rotation(clip, frame, mover), o);
  const kg_vec3 target = kg_quat_rotate(kg_quat_conj(A), kg_vec3_sub(p, P));
  const kg_vec3 t = kg_vec3_sub(target, below);
  const kg_vec3 change = kg_vec3_sub(t, local_translation(clip, frame, mover));
  if (!(kg_vec3_norm(change) <= 1e-13 * (1.0 + kg_vec3_norm(p)))) {
    kg_clip_set_translation(clip, frame, mover, t);
  }
}

void kg_body_state_to_clip(const kg_body *body, const double *q, kg_clip *clip, int frame,
                           int previous_frame)
{
  KG_ASSERT(frame >= 0 && frame < clip->frame_count);
  for (int i = 0; i < body->segment_count; i++) {
    const int joint = body->segments[i].joint;
    kg_vec3 unused;
    const kg_quat between =
      pose_relative(clip, frame, clip->joints[joint].parent, parent_joint(body, i), &unused);
    const kg_quat r = kg_quat_mul(kg_quat_conj(between), kg_state_quat(q, i));
    set_rotation_if_new(clip, frame, joint, kg_quat_normalized(r), previous_frame);
  }
  const int root = body->segments[0].joint;
  const int mover = moving_joint(clip, root);
  if (mover >= 0) {
    place_joint(clip, frame, root, mover, kg_load3(q));
  }
}

/* Help topics. What stands in a table elsewhere is printed from there. */
#include "cli/topics.h"

#include "cli/scene_file.h"
#include "cli/scores.h"
#include "kinegrad/clip.h"

static void print_formats(FILE *out)
{
  fputs("Read\n"
        "  BVH  any channel order, several position or rotation channels per joint, end sites\n"
        "  AMC  Acclaim motion with its ASF skeleton (--asf, or found by name beside the clip)\n"
        "  The content decides, not the name. Skeletons are mapped to 23 roles by joint names\n"
        "  (CMU, ASF, MotionBuilder and Mixamo, Xsens, SNU) or by --map.\n"
        "Written\n"
        "  BVH   hierarchy, channel order and frame time of the capture\n"
        "  JSON  reports (--json)\n"
        "  CSV   forces (--forces): a header line, then one line per frame\n"
        "  MJCF  the body for MuJoCo (info --mjcf)\n"
        "For --scene\n"
        "  OBJ, PLY, OFF, STL   meshes\n"
        "  JSON                 shapes, mats and what moves: 'kinegrad help scenes'\n",
        out);
}

static void print_scenes(FILE *out)
{
  fputs("What --scene puts beside the floor: mesh files, and descriptions whose names\n"
        "end in .json. Metres in the clip's world, Y up, as 'kinegrad info' prints the floor.\n"
        "  {\"floor\": {\"soft\": {\"thickness_m\": 0.03}},\n"
        "   \"shapes\": [\n"
        "     {\"type\": \"box\", \"center_m\": [2, 0.5, 0], \"size_m\": [1, 1, 1]},\n"
        "     {\"type\": \"capsule\", \"from_m\": [-1, 1.2, 1], \"to_m\": [1, 1.2, 1], "
        "\"radius_m\": 0.05},\n"
        "     {\"type\": \"mesh\", \"file\": \"stairs.obj\", \"unit_m\": 0.01}]}\n"
        "Types and their members\n",
        out);
  cli_print_scene_types(out);
  fputs(
    "  size_m are whole lengths; rotation_deg is an axis times the angle about it, in degrees.\n"
    "  A mesh file is looked for beside the description.\n"
    "  of is an array of shapes, the parts of a combination; a difference is the first part less\n"
    "  the others. Parts have no motion and no soft of their own, a combination has no soft.\n"
    "Every shape may have\n"
    "  velocity_m_per_s, spin_rad_per_s   [x, y, z]: it moves on from the first motion frame\n"
    "  soft   a layer inwards from what is drawn, rigid below (a mat needs it):\n"
    "         thickness_m, stiffness_N_per_m of one sample point, damping_s_per_m, friction\n",
    out);
  cli_print_scene_limits(out);
  fputs("Another athlete is a clip: --with of correct and eval. Examples and defaults stand in\n"
        "docs/guide/scenes.md.\n",
        out);
}

static void print_units(FILE *out)
{
  fputs("Inside and in every report: metres, seconds, kilograms, newtons, radians; Y is up.\n"
        "The unit of a file is estimated from the size of the skeleton (--unit tells it), its up\n"
        "axis from the rest pose (--up). The corrected clip has the file's own unit and axes, and\n"
        "angles in degrees, as BVH wants. Frames are counted from 0 as in the file, an inserted\n"
        "T-pose included; the time of a frame is its number times the frame time.\n",
        out);
}

static void print_exit_codes(FILE *out)
{
  fputs("  0    done, and the answer is good\n"
        "  1    done, but the answer is no: frames that no contact explains, a step that did not\n"
        "       converge, a lost simulation, an output more than 1 mm inside of something or far\n"
        "       from the capture, a clip without its output, answers of a benchmark that differ,\n"
        "       a derivative that is wrong or undecided\n"
        "  2    wrong usage\n"
        "  3    an input cannot be read, or cannot be used\n"
        "  4    an output cannot be written\n"
        "  130  interrupted\n"
        "With any code from 2 on no output is left behind. With 1 the outputs are complete.\n",
        out);
}

static void print_json(FILE *out)
{
  fputs("A report is one object; units stand in the names of the keys, what does not apply is\n"
        "null, numbers have 17 significant digits. Keys of correct and eval:\n"
        "  mpjpe_m  mpjpe_max_m  acceleration_peak_ratio  mpjpe_normalized_m\n",
        out);
  for (int i = 0; i < cli_score_count; i++) {
    fprintf(out, "  %-30s %s\n", cli_scores[i].key, cli_scores[i].text);
  }
  fputs("  penetration_frame  penetration_segments    where the deepest point is; the same with\n"
        "              other_ and self_ in front\n"
        "  capture     the same for the capture\n"
        "  joints      one array per key: name, mpjpe_m, ...\n"
        "  frames      one array per key: frame, time_s, mpjpe_m, penetration_m, ...\n"
        "  constants   every number the metrics rest on\n"
        "  clip floor body mapping    what was decided about the capture\n"
        "  scene other                what was in the way\n"
        "and of correct alone:\n"
        "  residual_force_rms_N  residual_force_over_weight\n"
        "  residual_force_ratio  residual_force_ratio_peak  residual_moment_ratio\n"
        "  residual_moment_ratio_peak  correction_force_ratio  correction_force_ratio_peak\n"
        "  peak_grf_N  unexplained_count  unexplained_frames  restart_frames  ms_per_frame\n"
        "  timing  newton\n"
        "gradcheck has one object per row under checks: name, method, max_relative_error,\n"
        "error_estimate, tolerance, dot_test, taylor_order (null: remainder at rounding),\n"
        "repeatable, passed.\n"
        "bench has one object per ratio under cases: name, value, unit, peer, peer_value, ratio,\n"
        "agreement.\n"
        "docs/guide/read-the-report.md defines those of correct and eval.\n",
        out);
}

static void print_roles(FILE *out)
{
  fputs("A map (--map) has one 'role = joint name' per line; # starts a comment. Roles:\n", out);
  for (int role = 0; role < KG_ROLE_COUNT; role++) {
    fprintf(out, "  %s\n", kg_role_name((kg_role)role));
  }
}

const cli_topic cli_topics[] = {
  {"formats", print_formats},       {"scenes", print_scenes}, {"units", print_units},
  {"exit-codes", print_exit_codes}, {"json", print_json},     {"roles", print_roles},
};
const int cli_topic_count = (int)KG_COUNT_OF(cli_topics);

/* Self-intersection: which triangles are cut by an edge of another.
 *
 * Two triangles that cut through each other have an edge of one that passes through the other, which
 * five signs of volumes decide:
 *   [a b c d] = (b - a) x (c - a) . (d - a)   six times the volume of a tetrahedron
 *   the ends p, q of the edge lie on both sides of the triangle: [a b c p], [a b c q] differ
 *   the line p q passes it on the same side of all edges:        [p q a b], [p q b c], [p q c a] agree
 * A sign counts only when it exceeds the rounding of the sum (filter of [SHEW] J. R. Shewchuk,
 * Adaptive precision floating-point arithmetic, Discrete Comput. Geom. 18, 1997), so that touching
 * is never taken for crossing. */
#include "sdf/boxes.h"
#include "sdf/topology.h"

enum { TESTS_PER_TRIANGLE = 400, TESTS_AT_LEAST = 100000 };

typedef struct search {
  const topology *topo;
  const boxes *tree;
  long long tests_left; /* of boxes and of pairs */
  int count;
  kg_vec3 where;
} search;

/* sign of [a b c d]; 0 when rounding could have made it */
static int side(kg_vec3 a, kg_vec3 b, kg_vec3 c, kg_vec3 d)
{
  const kg_vec3 u = kg_vec3_sub(b, a), v = kg_vec3_sub(c, a), w = kg_vec3_sub(d, a);
  const double x = u.y * v.z - u.z * v.y, y = u.z * v.x - u.x * v.z, z = u.x * v.y - u.y * v.x;
  const double sum = x * w.x + y * w.y + z * w.z;
  const double size = (fabs(u.y * v.z) + fabs(u.z * v.y)) * fabs(w.x) +
                      (fabs(u.z * v.x) + fabs(u.x * v.z)) * fabs(w.y) +
                      (fabs(u.x * v.y) + fabs(u.y * v.x)) * fabs(w.z);
  const double rounding = 8e-16 * size;
  return sum > rounding ? 1 : sum < -rounding ? -1 : 0;
}

static bool edge_cuts(const kg_vec3 p, const kg_vec3 q, const kg_vec3 t[3])
{
  const int at_p = side(t[0], t[1], t[2], p);
  if (at_p == 0 || at_p * side(t[0], t[1], t[2], q) >= 0) return false;
  const int first = side(p, q, t[0], t[1]);
  return first != 0 && first == side(p, q, t[1], t[2]) && first == side(p, q, t[2], t[0]);
}

static bool pair_cuts(const kg_vec3 s[3], const kg_vec3 t[3])
{
  for (int k = 0; k < 3; k++) {
    if (edge_cuts(s[k], s[(k + 1) % 3], t) || edge_cuts(t[k], t[(k + 1) % 3], s)) return true;
  }
  return false;
}

static bool share_corner(const int *a, const int *b)
{
  for (int i = 0; i < 3; i++) {
    if (a[i] == b[0] || a[i] == b[1] || a[i] == b[2]) return true;
  }
  return false;
}

static void face_corners(int face, kg_vec3 out[3], const void *user)
{
  const topology *topo = user;
  for (int k = 0; k < 3; k++) {
    out[k] = topo->vertices[topo->corner[face][k]];
  }
}

static void try_pair(search *s, int face, const kg_vec3 t[3], int other)
{
  kg_vec3 u[3];
  if (other <= face || share_corner(s->topo->corner[face], s->topo->corner[other])) return;
  face_corners(other, u, s->topo);
  s->tests_left--;
  if (pair_cuts(t, u) && s->count++ == 0) {
    s->where = kg_vec3_scale(1.0 / 3.0, kg_vec3_add(kg_vec3_add(t[0], t[1]), t[2]));
  }
}

static bool overlaps(const boxes_node *node, const boxes_box *box)
{
  for (int i = 0; i < 3; i++) {
    if (node->lo[i] > box->hi[i] || node->hi[i] < box->lo[i]) return false;
  }
  return true;
}

static void search_face(search *s, int face)
{
  kg_vec3 t[3];
  face_corners(face, t, s->topo);
  const boxes_box box = boxes_around(t);
  int stack[BOXES_STACK], top = 0;
  stack[top++] = 0;
  while (top > 0 && s->tests_left > 0) {
    const boxes_node *node = &s->tree->nodes[stack[--top]];
    s->tests_left--;
    if (!overlaps(node, &box)) continue;
    if (node->count == 0) {
      stack[top++] = node->first + 1;
      stack[top++] = node->first;
    }
    for (int j = 0; j < node->count; j++) {
      try_pair(s, face, t, s->tree->order[node->first + j]);
    }
  }
}

bool crossings_describe(const topology *topo, kg_mesh_report *report, kg_arena *arena)
{
  boxes tree;
  if (!boxes_build(&tree, topo->face_count, face_corners, topo, arena)) return false;
  const long long most = (long long)TESTS_PER_TRIANGLE * topo->face_count;
  search s = {.topo = topo, .tree = &tree};
  s.tests_left = most > TESTS_AT_LEAST ? most : TESTS_AT_LEAST;
  for (int face = 0; face < topo->face_count && s.tests_left > 0; face++) {
    search_face(&s, face);
  }
  report->crossings = s.count;
  if (s.count > 0) {
    report_say(report,
               "self-intersection: %s%d %s of triangles cut through each other, the first at "
               "(%.4g, %.4g, %.4g); inside the overlap the sign may be wrong and the depth is that "
               "to the nearest sheet\n",
               s.tests_left > 0 ? "" : "at least ", s.count, word_for(s.count, "pair", "pairs"),
               s.where.x, s.where.y, s.where.z);
  } else if (s.tests_left <= 0) {
    report_say(report, "self-intersection: not searched to the end, too many triangles overlap\n");
  }
  return true;
}

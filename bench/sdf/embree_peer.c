/* Embree 3 finds the leaves, a callback the closest point of each triangle in them: C. Ericson,
 * Real-Time Collision Detection, Morgan Kaufmann 2005, section 5.1.5, in floats as Embree's own
 * tutorial has it. */
#include "bench/sdf/embree_peer.h"

#include <embree3/rtcore.h>
#include <math.h>
#include <stdlib.h>

struct kg_embree {
  int vertex_count, triangle_count;
  float *vertices;     /* (vertex_count, 3) and one more to read past the end */
  unsigned *triangles; /* (triangle_count, 3)                                 */
  RTCDevice device;
  RTCScene scene;
};

typedef struct answer {
  const kg_embree *of;
  float distance2;
  int triangle;
} answer;

typedef struct f3 {
  float x, y, z;
} f3;

static inline f3 sub(f3 a, f3 b)
{
  return (f3){a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline f3 add_scaled(f3 a, float s, f3 b)
{
  return (f3){a.x + s * b.x, a.y + s * b.y, a.z + s * b.z};
}

static inline float dot(f3 a, f3 b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline float square(f3 a)
{
  return dot(a, a);
}

static inline f3 vertex(const kg_embree *e, unsigned i)
{
  const float *v = &e->vertices[3 * (size_t)i];
  return (f3){v[0], v[1], v[2]};
}

static float triangle_distance2(const kg_embree *e, int triangle, f3 x)
{
  const unsigned *t = &e->triangles[3 * (size_t)triangle];
  const f3 a = vertex(e, t[0]), u = sub(vertex(e, t[1]), a), v = sub(vertex(e, t[2]), a);
  const f3 p = sub(x, a);
  const float d1 = dot(u, p), d2 = dot(v, p);
  if (d1 <= 0.0f && d2 <= 0.0f) return square(p);
  const f3 q = sub(p, u);
  const float d3 = dot(u, q), d4 = dot(v, q);
  if (d3 >= 0.0f && d4 <= d3) return square(q);
  const float vc = d1 * d4 - d3 * d2;
  if (vc <= 0.0f && d1 >= 0.0f && d3 <= 0.0f) return square(add_scaled(p, -d1 / (d1 - d3), u));
  const f3 r = sub(p, v);
  const float d5 = dot(u, r), d6 = dot(v, r);
  if (d6 >= 0.0f && d5 <= d6) return square(r);
  const float vb = d5 * d2 - d1 * d6;
  if (vb <= 0.0f && d2 >= 0.0f && d6 <= 0.0f) return square(add_scaled(p, -d2 / (d2 - d6), v));
  const float va = d3 * d6 - d5 * d4;
  if (va <= 0.0f && d4 - d3 >= 0.0f && d5 - d6 >= 0.0f) {
    return square(add_scaled(q, -(d4 - d3) / ((d4 - d3) + (d5 - d6)), sub(v, u)));
  }
  const float scale = 1.0f / (va + vb + vc);
  return square(add_scaled(add_scaled(p, -vb * scale, u), -vc * scale, v));
}

static bool visit(struct RTCPointQueryFunctionArguments *args)
{
  answer *best = args->userPtr;
  const f3 x = {args->query->x, args->query->y, args->query->z};
  const float distance2 = triangle_distance2(best->of, (int)args->primID, x);
  if (!(distance2 < best->distance2)) {
    return false;
  }
  best->distance2 = distance2;
  best->triangle = (int)args->primID;
  args->query->radius = sqrtf(distance2);
  return true; /* the radius has shrunk */
}

double kg_embree_distance(kg_embree *e, kg_vec3 x, int *hint)
{
  struct RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  struct RTCPointQuery query = {(float)x.x, (float)x.y, (float)x.z, 0.0f, INFINITY};
  answer best = {e, INFINITY, -1};
  if (hint && *hint >= 0) {
    best.triangle = *hint;
    best.distance2 = triangle_distance2(e, *hint, (f3){query.x, query.y, query.z});
    query.radius = sqrtf(best.distance2);
  }
  rtcPointQuery(e->scene, &query, &context, visit, &best);
  if (hint) {
    *hint = best.triangle;
  }
  return sqrtf(best.distance2);
}

static bool fill(kg_embree *e, const kg_bench_surface *s)
{
  e->vertex_count = s->vertex_count;
  e->triangle_count = s->triangle_count;
  e->vertices = malloc(3 * ((size_t)s->vertex_count + 1) * sizeof *e->vertices);
  e->triangles = malloc(3 * (size_t)s->triangle_count * sizeof *e->triangles);
  if (!e->vertices || !e->triangles) {
    return false;
  }
  for (int i = 0; i < s->vertex_count; i++) {
    e->vertices[3 * i] = (float)s->vertices[i].x;
    e->vertices[3 * i + 1] = (float)s->vertices[i].y;
    e->vertices[3 * i + 2] = (float)s->vertices[i].z;
  }
  for (size_t k = 0; k < 3 * (size_t)s->triangle_count; k++) {
    e->triangles[k] = (unsigned)s->triangles[k];
  }
  e->device = rtcNewDevice("threads=1");
  return e->device != NULL;
}

kg_status kg_embree_open(kg_embree **embree, const kg_bench_surface *s)
{
  kg_embree *e = calloc(1, sizeof *e);
  if (!e || !fill(e, s)) {
    kg_embree_close(e);
    return KG_ERR_NO_MEMORY;
  }
  *embree = e;
  return KG_OK;
}

void kg_embree_close(kg_embree *e)
{
  if (!e) {
    return;
  }
  if (e->scene) {
    rtcReleaseScene(e->scene);
  }
  if (e->device) {
    rtcReleaseDevice(e->device);
  }
  free(e->vertices);
  free(e->triangles);
  free(e);
}

kg_status kg_embree_build(kg_embree *e)
{
  if (e->scene) {
    rtcReleaseScene(e->scene);
  }
  e->scene = rtcNewScene(e->device);
  RTCGeometry geometry = rtcNewGeometry(e->device, RTC_GEOMETRY_TYPE_TRIANGLE);
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, e->vertices, 0,
                             3 * sizeof *e->vertices, (size_t)e->vertex_count);
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, e->triangles, 0,
                             3 * sizeof *e->triangles, (size_t)e->triangle_count);
  rtcSetGeometryBuildQuality(geometry, RTC_BUILD_QUALITY_MEDIUM);
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(e->scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcSetSceneBuildQuality(e->scene, RTC_BUILD_QUALITY_MEDIUM);
  rtcCommitScene(e->scene);
  return rtcGetDeviceError(e->device) == RTC_ERROR_NONE ? KG_OK : KG_ERR_NO_MEMORY;
}

/* Polygons into triangles. Internal to sdf/. */
#ifndef KG_SDF_POLYGON_H
#define KG_SDF_POLYGON_H

#include "kinegrad/vec3.h"

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { POLYGON_MOST_CONCAVE = 512 }; /* corners; beyond, cutting takes too long */

typedef struct polygon_cut {
  bool tangled;  /* its outline crosses itself: there is no right way to cut it        */
  bool too_long; /* concave with more corners than POLYGON_MOST_CONCAVE: was not cut   */
  double bent;   /* m: how far a corner stands off the mean plane                      */
  double size;   /* m: largest distance of a corner from the first one                 */
} polygon_cut;

/* Convex polygons become a fan from the first corner, others lose one ear after another.
 * triangles: (n - 2, 3) numbers of corners, counter-clockwise like the polygon. work: (n). n >= 3. */
polygon_cut polygon_triangles(int *triangles, int *work, const kg_vec3 *corners, int n);

#ifdef __cplusplus
}
#endif
#endif

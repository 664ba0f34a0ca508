// CGAL behind C functions.
#include "bench/sdf/cgal_peer.h"

#include <CGAL/AABB_traits.h>
#include <CGAL/AABB_tree.h>
#include <CGAL/AABB_triangle_primitive.h>
#include <CGAL/Simple_cartesian.h>

#include <cmath>
#include <new>
#include <vector>

namespace
{

typedef CGAL::Simple_cartesian<double> kernel;
typedef std::vector<kernel::Triangle_3> triangles;
typedef CGAL::AABB_triangle_primitive<kernel, triangles::const_iterator> primitive;
typedef CGAL::AABB_tree<CGAL::AABB_traits<kernel, primitive>> tree;

kernel::Point_3 point(kg_vec3 p)
{
  return kernel::Point_3(p.x, p.y, p.z);
}

} // namespace

struct kg_cgal {
  triangles faces;
  tree built;
};

kg_status kg_cgal_open(kg_cgal **cgal, const kg_bench_surface *s)
{
  try {
    kg_cgal *c = new kg_cgal;
    for (int i = 0; i < s->triangle_count; i++) {
      const int *v = &s->triangles[3 * static_cast<std::size_t>(i)];
      c->faces.emplace_back(point(s->vertices[v[0]]), point(s->vertices[v[1]]),
                            point(s->vertices[v[2]]));
    }
    *cgal = c;
    return KG_OK;
  } catch (const std::bad_alloc &) {
    return KG_ERR_NO_MEMORY;
  }
}

void kg_cgal_close(kg_cgal *cgal)
{
  delete cgal;
}

kg_status kg_cgal_build(kg_cgal *cgal)
{
  try {
    cgal->built.clear();
    cgal->built.insert(cgal->faces.begin(), cgal->faces.end());
    cgal->built.build();
    return cgal->built.accelerate_distance_queries() ? KG_OK : KG_ERR_NO_MEMORY;
  } catch (const std::bad_alloc &) {
    return KG_ERR_NO_MEMORY;
  }
}

double kg_cgal_distance(const kg_cgal *cgal, kg_vec3 x)
{
  return std::sqrt(cgal->built.squared_distance(point(x)));
}

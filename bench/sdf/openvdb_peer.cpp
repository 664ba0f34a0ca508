// OpenVDB behind C functions.
#include "bench/sdf/openvdb_peer.h"

#include <openvdb/openvdb.h>
#include <openvdb/tools/Interpolation.h>
#include <openvdb/tools/MeshToVolume.h>
#include <tbb/global_control.h>

#include <memory>
#include <vector>

struct kg_openvdb {
  tbb::global_control one_thread{tbb::global_control::max_allowed_parallelism, 1};
  openvdb::math::Transform::Ptr transform;
  std::vector<openvdb::Vec3s> points;
  std::vector<openvdb::Vec3I> triangles;
  openvdb::FloatGrid::Ptr grid;
};

kg_status kg_openvdb_open(kg_openvdb **vdb, const kg_bench_surface *s, double spacing)
{
  try {
    openvdb::initialize();
    auto built = std::make_unique<kg_openvdb>();
    built->transform = openvdb::math::Transform::createLinearTransform(spacing);
    for (int i = 0; i < s->vertex_count; i++) {
      const kg_vec3 p = s->vertices[i];
      built->points.emplace_back(float(p.x), float(p.y), float(p.z));
    }
    for (int i = 0; i < s->triangle_count; i++) {
      const int *t = s->triangles + 3 * i;
      built->triangles.emplace_back(unsigned(t[0]), unsigned(t[1]), unsigned(t[2]));
    }
    *vdb = built.release();
    return KG_OK;
  } catch (...) {
    return KG_ERR_NO_MEMORY;
  }
}

void kg_openvdb_close(kg_openvdb *vdb)
{
  delete vdb;
}

kg_status kg_openvdb_build(kg_openvdb *vdb, double band)
{
  try {
    vdb->grid.reset();
    vdb->grid = band <= 3.0
                  ? openvdb::tools::meshToLevelSet<openvdb::FloatGrid>(*vdb->transform, vdb->points,
                                                                       vdb->triangles, float(band))
                  : openvdb::tools::meshToSignedDistanceField<openvdb::FloatGrid>(
                      *vdb->transform, vdb->points, vdb->triangles, {}, float(band), float(band));
    return KG_OK;
  } catch (...) {
    return KG_ERR_NO_MEMORY;
  }
}

void kg_openvdb_distances(const kg_openvdb *vdb, int count, const kg_vec3 *x, double *distance)
{
  const auto accessor = vdb->grid->getConstAccessor();
  const openvdb::tools::GridSampler<openvdb::FloatGrid::ConstAccessor, openvdb::tools::BoxSampler>
    sampler(accessor, *vdb->transform);
  for (int i = 0; i < count; i++) {
    distance[i] = double(sampler.wsSample(openvdb::Vec3d(x[i].x, x[i].y, x[i].z)));
  }
}

/* Any bytes as a mesh file with the extension FUZZ_EXTENSION: an error, or a mesh whose distances are
 * numbers. One program for each format. */
#include "fuzz.h"

#include <unistd.h>

#include "kinegrad/mesh.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  char path[64];
  snprintf(path, sizeof path, "fuzz_mesh_%ld." FUZZ_EXTENSION, (long)getpid());
  FILE *file = fopen(path, "wb");
  FUZZ_CHECK(file != NULL);
  FUZZ_CHECK(fwrite(data, 1, size, file) == size);
  fclose(file);
  kg_mesh *mesh;
  kg_mesh_report report;
  kg_error error = {.status = KG_OK};
  const kg_status status = kg_mesh_read(&mesh, path, 1.0, &report, NULL, &error);
  unlink(path);
  if (status != KG_OK) {
    FUZZ_CHECK(!mesh && error.status == status && error.text[0] != '\0');
    FUZZ_CHECK(memchr(error.text, '\n', sizeof error.text) == NULL);
    return 0;
  }
  FUZZ_CHECK(report.triangles > 0 && report.vertices >= 3);
  for (int i = 0; i < 8; i++) {
    const kg_sdf_value v = kg_mesh_distance(mesh, kg_vec3_make(0.3 * i, 0.5, 1.0 - 0.2 * i));
    FUZZ_CHECK(isfinite(v.distance) && fabs(kg_vec3_norm(v.normal) - 1.0) < 1e-6);
  }
  kg_mesh_destroy(mesh);
  return 0;
}

/* Any bytes as a grid file: an error, or a grid whose answers are numbers.
 * The last eight bytes are made the right checksum first, or nothing would pass it. */
#include "fuzz.h"

#include <unistd.h>

#include "kinegrad/grid.h"

static void use(const kg_grid *grid)
{
  const kg_grid_info info = kg_grid_describe(grid);
  FUZZ_CHECK(info.spacing > 0.0 && info.n[0] >= 2 && info.n[1] >= 2 && info.n[2] >= 2);
  for (int i = 0; i < 12; i++) {
    const double t = 0.13 * i - 0.2;
    const kg_vec3 x = kg_vec3_make(info.lo.x + t * (info.hi.x - info.lo.x),
                                   info.lo.y + (1.0 - t) * (info.hi.y - info.lo.y),
                                   info.lo.z + 0.4 * (info.hi.z - info.lo.z));
    const kg_grid_value v = kg_grid_distance(grid, x);
    FUZZ_CHECK(isfinite(v.distance) && isfinite(v.error) && v.error >= 0.0 && !v.is_exact);
    FUZZ_CHECK(isfinite(kg_vec3_norm(v.gradient)));
    /* whether it is right only the surface could tell, which is not in the file */
    const double bound = kg_grid_lower_bound(grid, x);
    FUZZ_CHECK(bound >= 0.0 && isfinite(bound));
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  char path[64];
  snprintf(path, sizeof path, "fuzz_grid_%ld.kggrid", (long)getpid());
  FILE *file = fopen(path, "wb");
  FUZZ_CHECK(file != NULL);
  uint64_t sum = 14695981039346656037u;
  const size_t body = size > 8 ? size - 8 : size;
  for (size_t i = 0; i < body; i++) {
    sum = (sum ^ data[i]) * 1099511628211u;
  }
  FUZZ_CHECK(fwrite(data, 1, body, file) == body);
  for (size_t i = body; i < size; i++) {
    fputc((int)(sum >> (8 * (i - body)) & 0xff), file);
  }
  fclose(file);
  kg_grid *grid;
  kg_error error = {.status = KG_OK};
  const kg_status status = kg_grid_load(&grid, path, NULL, NULL, &error);
  unlink(path);
  if (status != KG_OK) {
    FUZZ_CHECK(!grid && error.status == status && error.text[0] != '\0');
    FUZZ_CHECK(memchr(error.text, '\n', sizeof error.text) == NULL);
    return 0;
  }
  use(grid);
  kg_grid_destroy(grid);
  return 0;
}

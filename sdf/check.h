/* What a mesh file must be before OpenMesh's readers see it: they trust counts, lengths and indices,
 * take a file that ends early for a short one, and never say where. Internal to sdf/. */
#ifndef KG_SDF_CHECK_H
#define KG_SDF_CHECK_H

#include "kinegrad/base.h"

#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

/* In: the file. Out: what it holds, and where `plain_size` > 0 the same mesh in the plainest form
 * of its format, without comments, colours and names of other files. */
typedef struct mesh_file {
  const char *path, *content;
  size_t size;
  char *plain; /* room for CHECK_ROOM(size) bytes */
  size_t plain_size;
  long long vertices, faces; /* -1: the format repeats vertices; faces without the collapsed */
  long long collapsed;       /* with fewer than three different corners: the readers drop them */
  long long corners; /* of the faces, without neighbours that are the same; 0: not counted */
  bool binary;
} mesh_file;

/* facets of a text STL without normals get some */
#define CHECK_ROOM(size) ((size) + (size) / 4 + 64)

/* Behind what the plain copy holds. */
static inline void check_put(mesh_file *file, const void *bytes, size_t count)
{
  memcpy(file->plain + file->plain_size, bytes, count);
  file->plain_size += count;
}

static inline void check_put_text(mesh_file *file, const char *text)
{
  check_put(file, text, strlen(text));
}

/* KG_ERR_FORMAT with line and column, or in a binary file with the byte in the text.
 * KG_ERR_UNSUPPORTED: legal, not read. */
kg_status check_obj(mesh_file *file, kg_error *error);
kg_status check_off(mesh_file *file, kg_error *error);
kg_status check_stl(mesh_file *file, kg_error *error);
kg_status check_ply(mesh_file *file, kg_error *error);

#ifdef __cplusplus
}
#endif
#endif

/* Scenes of a run: mesh files, and files that describe a scene (docs/guide/scenes.md). */
#ifndef CLI_SCENE_FILE_H
#define CLI_SCENE_FILE_H

#include <stdio.h>

#include "cli/options.h"
#include "kinegrad/sdf.h"

/* those of descriptions take a place each */
enum { CLI_MAX_MESHES = KG_SCENE_MAX_PLACES + CLI_MAX_PATHS };

typedef struct cli_scene {
  kg_scene scene;         /* beside the floor                              */
  const char *floor_file; /* that says what covers the floor; NULL: none   */
  kg_ground floor;        /* the cover                                     */
  int mesh_count;
  kg_mesh *meshes[CLI_MAX_MESHES];
  char *mesh_paths[CLI_MAX_MESHES]; /* where they were read */
} cli_scene;

/* Adds a file: a description when its name ends in .json, a mesh in units of unit_m metres otherwise.
 * CLI_GOOD, or an exit code after a message. What is odd about a mesh is warned of. Borrows the path. */
int cli_scene_add(cli_scene *scene, const char *path, double unit_m, bool is_quiet);
void cli_scene_release(cli_scene *scene);

/* For the help: the types of shapes with their members, and how many shapes there may be. */
void cli_print_scene_types(FILE *out);
void cli_print_scene_limits(FILE *out);

#endif

/* Scenes of a run: mesh files, and files that describe a scene (docs/guide/scenes.md). */
#ifndef CLI_SCENE_FILE_H
#define CLI_SCENE_FILE_H

#include "kinegrad/sdf.h"

enum { CLI_MAX_MESHES = 64 };

typedef struct cli_scene {
  kg_scene scene; /* beside the floor                */
  bool has_floor; /* the floor is covered by `floor` */
  kg_ground floor;
  int mesh_count;
  kg_mesh *meshes[CLI_MAX_MESHES];
  char *mesh_paths[CLI_MAX_MESHES]; /* where they were read */
} cli_scene;

/* Adds a file: a description when its name ends in .json, a mesh in units of unit_m metres otherwise.
 * CLI_GOOD, or an exit code after a message. What is odd about a mesh is warned of. */
int cli_scene_add(cli_scene *scene, const char *path, double unit_m, bool is_quiet);
void cli_scene_release(cli_scene *scene);

#endif

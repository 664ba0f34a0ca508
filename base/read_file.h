/* Whole files into memory. */
#ifndef BASE_READ_FILE_H
#define BASE_READ_FILE_H

#include "kinegrad/arena.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Memory from arena. KG_ERR_READ with the system's reason, KG_ERR_NO_MEMORY. */
kg_status kg_read_file(char **content, size_t *length, kg_arena *arena, const char *path,
                       kg_error *error);

#ifdef __cplusplus
}
#endif
#endif

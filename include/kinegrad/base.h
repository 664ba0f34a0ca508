/* kinegrad/base.h - status codes, error detail and allocator shared by every module.
 *
 * Three kinds of trouble, three channels:
 *   a mistake in the calling code     -> KG_ASSERT, stops a debug build
 *   the world said no (memory, file)  -> negative kg_status, detail in kg_error
 *   the mathematics said no           -> KG_OK, and the report says why it stopped
 */
#ifndef KINEGRAD_BASE_H
#define KINEGRAD_BASE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(__GNUC__)
#define KG_API __attribute__((visibility("default")))
#define KG_MUST_USE __attribute__((warn_unused_result))
#define KG_PRINTF(format_index, first_index)                                                       \
  __attribute__((format(printf, format_index, first_index)))
#else
#define KG_API
#define KG_MUST_USE
#define KG_PRINTF(format_index, first_index)
#endif

/* clang-format off */
/* One list, three uses: the enum, kg_status_text() and the table in docs/errors.md. */
#define KG_STATUS_LIST(X)                                                        \
  X(KG_OK, 0, "success")                                                         \
  X(KG_ERR_NO_MEMORY, -1, "out of memory")                                       \
  X(KG_ERR_UNDEFINED, -2, "a function is undefined where its value is needed")   \
  X(KG_ERR_READ, -3, "file cannot be read")                                      \
  X(KG_ERR_FORMAT, -4, "file content does not follow its format")                \
  X(KG_ERR_WRITE, -5, "file cannot be written")                                  \
  X(KG_ERR_UNMAPPED, -6, "skeleton cannot be mapped to a body")                  \
  X(KG_ERR_UNSUPPORTED, -7, "valid input that this version does not handle")     \
  X(KG_ERR_SHAPE, -8, "operands whose shapes do not fit together")               \
  X(KG_ERR_STALE, -9, "a recorded comparison came out the other way")

#define KG_STATUS_ENUM(name, value, text) name = (value),
typedef enum kg_status { KG_STATUS_LIST(KG_STATUS_ENUM) } kg_status;
#undef KG_STATUS_ENUM
/* clang-format on */

/* Static text for a status; "unknown status" for any other number. */
KG_API const char *kg_status_text(kg_status status);

/* Where and why. Filled only on failure; every function that takes one accepts NULL. */
typedef struct kg_error {
  kg_status status;
  long line;      /* in an input file, from 1; 0 when no file position is involved */
  long column;    /* in bytes, from 1; 0 when unknown                              */
  char path[512]; /* the file, "" when no file is involved; a long path is cut     */
  char text[512]; /* one sentence, no newline: what is wrong, what was expected    */
} kg_error;

/* Fills *error (NULL allowed) and returns status, so that failures read
 *   return kg_fail(error, KG_ERR_FORMAT, path, line, column, "...", ...);                        */
KG_API kg_status kg_fail(kg_error *error, kg_status status, const char *path, long line,
                         long column, const char *format, ...) KG_PRINTF(6, 7);

/* Memory source. bytes passed to free equals bytes passed to alloc. Returned memory is aligned
 * for any type. Everywhere a `const kg_allocator *` is taken, NULL means malloc and free. The
 * pointed-to allocator must outlive the object. */
typedef struct kg_allocator {
  void *(*alloc)(size_t bytes, void *user);
  void (*free)(void *memory, size_t bytes, void *user);
  void *user;
} kg_allocator;

/* A mistake in the calling code: stops a debug build, undefined as documented in a release. */
#ifndef NDEBUG
KG_API void kg_assert_failed(const char *condition, const char *file, int line);
#define KG_ASSERT(condition)                                                                       \
  ((condition) ? (void)0 : kg_assert_failed(#condition, __FILE__, __LINE__))
#else
#define KG_ASSERT(condition) ((void)0)
#endif

#define KG_COUNT_OF(array) (sizeof(array) / sizeof((array)[0]))

#ifdef __cplusplus
}
#endif
#endif

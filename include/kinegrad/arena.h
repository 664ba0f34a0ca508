/* kinegrad/arena.h - memory that lives as long as its owner: allocate many times, free once.
 *
 * An object keeps one arena, takes all its arrays from it in create() and releases it in destroy().
 * After the first failed allocation every later one fails too (kg_arena_failed), so a create
 * function may allocate everything and check once. Not thread-safe; one arena per object. */
#ifndef KINEGRAD_ARENA_H
#define KINEGRAD_ARENA_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_arena_block kg_arena_block;

typedef struct kg_arena {
  const kg_allocator *allocator; /* NULL: malloc and free         */
  kg_arena_block *last;          /* newest block, chained          */
  kg_arena_block *spare;         /* blocks a rewind has emptied    */
  bool failed;                   /* an allocation was refused      */
} kg_arena;

/* Allocates nothing. */
KG_API void kg_arena_init(kg_arena *arena, const kg_allocator *allocator);

/* Zeroed memory for count elements of size bytes, aligned to 64 bytes; NULL when memory is refused
 * or count * size overflows. count == 0 gives a valid pointer that must not be read. */
KG_API void *kg_arena_alloc(kg_arena *arena, size_t count, size_t size);

/* Copy of the first length bytes of text, zero-terminated. */
KG_API char *kg_arena_text(kg_arena *arena, const char *text, size_t length);

/* Memory with any content for bytes bytes, at a multiple of alignment (a power of two, at most
 * 64). */
KG_API void *kg_arena_take(kg_arena *arena, size_t bytes, size_t alignment);

KG_API bool kg_arena_failed(const kg_arena *arena);

/* A position to return to. What was allocated after kg_arena_mark is given up by kg_arena_rewind;
 * its blocks stay with the arena, so that repeating the same allocations takes no new memory. */
typedef struct kg_arena_mark {
  kg_arena_block *last;
  size_t used;
} kg_arena_mark;

KG_API kg_arena_mark kg_arena_mark_of(const kg_arena *arena);
/* Also forgets a failed allocation. */
KG_API void kg_arena_rewind(kg_arena *arena, kg_arena_mark mark);

/* Bytes held from the allocator, spare blocks included. */
KG_API size_t kg_arena_bytes(const kg_arena *arena);

/* Frees every block; the arena may be used again. */
KG_API void kg_arena_release(kg_arena *arena);

#define KG_ARENA_ARRAY(arena, type, count)                                                         \
  ((type *)kg_arena_alloc((arena), (size_t)(count), sizeof(type)))

#ifdef __cplusplus
}
#endif
#endif

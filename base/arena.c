/* A chain of blocks, newest first; each block is handed out from its start to its end. */
#include "kinegrad/arena.h"

#include <stdlib.h>
#include <string.h>

enum { ALIGNMENT = 64, SMALLEST_BLOCK = 4096 };

struct kg_arena_block {
  kg_arena_block *previous;
  size_t bytes; /* of the whole block, header included */
  size_t used;  /* offset of the first free byte       */
};

static void *take(const kg_allocator *allocator, size_t bytes)
{
  return allocator ? allocator->alloc(bytes, allocator->user) : malloc(bytes);
}

static void give_back(const kg_allocator *allocator, void *memory, size_t bytes)
{
  if (allocator) {
    allocator->free(memory, bytes, allocator->user);
  } else {
    free(memory);
  }
}

/* offset of the first aligned address at or after block + offset */
static size_t align_up(const kg_arena_block *block, size_t offset)
{
  const uintptr_t address = (uintptr_t)block + offset;
  return offset + (size_t)(-address & (ALIGNMENT - 1));
}

static bool add_block(kg_arena *arena, size_t payload)
{
  const size_t header = sizeof(kg_arena_block) + ALIGNMENT;
  /* each block is twice as large as the last: few blocks, little waste */
  size_t bytes = arena->last ? 2 * arena->last->bytes : SMALLEST_BLOCK;
  if (payload > SIZE_MAX - header) {
    return false;
  }
  if (bytes < payload + header || bytes > 16 * (payload + header) + SMALLEST_BLOCK) {
    bytes = payload + header;
  }
  kg_arena_block *block = take(arena->allocator, bytes);
  if (!block) {
    return false;
  }
  *block = (kg_arena_block){.previous = arena->last, .bytes = bytes, .used = sizeof *block};
  arena->last = block;
  return true;
}

void kg_arena_init(kg_arena *arena, const kg_allocator *allocator)
{
  *arena = (kg_arena){.allocator = allocator};
}

void *kg_arena_alloc(kg_arena *arena, size_t count, size_t size)
{
  KG_ASSERT(arena && size > 0);
  if (arena->failed || (count > 0 && size > SIZE_MAX / count)) {
    arena->failed = true;
    return NULL;
  }
  const size_t bytes = count * size;
  size_t start = arena->last ? align_up(arena->last, arena->last->used) : 0;
  if (!arena->last || start > arena->last->bytes || bytes > arena->last->bytes - start) {
    if (!add_block(arena, bytes)) {
      arena->failed = true;
      return NULL;
    }
    start = align_up(arena->last, arena->last->used);
  }
  arena->last->used = start + bytes;
  char *memory = (char *)arena->last + start;
  memset(memory, 0, bytes);
  return memory;
}

char *kg_arena_text(kg_arena *arena, const char *text, size_t length)
{
  char *copy = kg_arena_alloc(arena, length + 1, 1);
  if (copy) {
    memcpy(copy, text, length); /* the terminator is already there */
  }
  return copy;
}

bool kg_arena_failed(const kg_arena *arena)
{
  return arena->failed;
}

void kg_arena_release(kg_arena *arena)
{
  while (arena->last) {
    kg_arena_block *block = arena->last;
    arena->last = block->previous;
    give_back(arena->allocator, block, block->bytes);
  }
  arena->failed = false;
}

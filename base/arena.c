/* A chain of blocks, newest first; each block is handed out from its start to its end. */
#define _DEFAULT_SOURCE /* madvise */

#include "kinegrad/arena.h"

#include <stdlib.h>
#include <string.h>

#if defined(__linux__)
#include <sys/mman.h>
#endif

enum { ALIGNMENT = 64, SMALLEST_BLOCK = 4096, MANY = 65536, HUGE_PAGE = 2 << 20 };

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

/* offset of the first address at or after block + offset that is a multiple of alignment */
static size_t align_up(const kg_arena_block *block, size_t offset, size_t alignment)
{
  const uintptr_t address = (uintptr_t)block + offset;
  return offset + (size_t)(-address & (alignment - 1));
}

/* takes the first spare block of at least bytes out of its list; NULL when there is none */
static kg_arena_block *reuse_block(kg_arena *arena, size_t bytes)
{
  for (kg_arena_block **link = &arena->spare; *link; link = &(*link)->previous) {
    kg_arena_block *block = *link;
    if (block->bytes >= bytes) {
      *link = block->previous;
      return block;
    }
  }
  return NULL;
}

/* Large blocks are read all over, and written first page by page: pages of 2 MB spare misses of the page
 * table and faults. A wish; where it is not known or refused nothing changes. */
static void wish_for_huge_pages(void *memory, size_t bytes)
{
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  const size_t before = -(uintptr_t)memory & (HUGE_PAGE - 1);
  if (bytes < before + HUGE_PAGE) return;
  (void)madvise((char *)memory + before, (bytes - before) & ~(size_t)(HUGE_PAGE - 1),
                MADV_HUGEPAGE);
#else
  (void)memory;
  (void)bytes;
#endif
}

static kg_arena_block *new_block(kg_arena *arena, size_t least)
{
  /* each block is twice as large as the last: few blocks, little waste */
  size_t bytes = arena->last ? 2 * arena->last->bytes : SMALLEST_BLOCK;
  if (bytes > 16 * least + MANY) {
    bytes = 16 * least + MANY;
  }
  bytes = bytes < least ? least : bytes;
  kg_arena_block *block = take(arena->allocator, bytes);
  if (block) {
    wish_for_huge_pages(block, bytes);
    block->bytes = bytes;
  }
  return block;
}

static bool add_block(kg_arena *arena, size_t payload)
{
  const size_t header = sizeof(kg_arena_block) + ALIGNMENT;
  if (payload > SIZE_MAX / 32 - header) {
    return false;
  }
  kg_arena_block *block = reuse_block(arena, payload + header);
  block = block ? block : new_block(arena, payload + header);
  if (!block) {
    return false;
  }
  block->previous = arena->last;
  block->used = sizeof *block;
  arena->last = block;
  return true;
}

void kg_arena_init(kg_arena *arena, const kg_allocator *allocator)
{
  *arena = (kg_arena){.allocator = allocator};
}

void *kg_arena_take(kg_arena *arena, size_t bytes, size_t alignment)
{
  KG_ASSERT(arena && alignment > 0 && alignment <= ALIGNMENT);
  if (arena->failed) {
    return NULL;
  }
  size_t start = arena->last ? align_up(arena->last, arena->last->used, alignment) : 0;
  if (!arena->last || start > arena->last->bytes || bytes > arena->last->bytes - start) {
    if (!add_block(arena, bytes)) {
      arena->failed = true;
      return NULL;
    }
    start = align_up(arena->last, arena->last->used, alignment);
  }
  arena->last->used = start + bytes;
  return (char *)arena->last + start;
}

void *kg_arena_alloc(kg_arena *arena, size_t count, size_t size)
{
  KG_ASSERT(arena && size > 0);
  if (count > 0 && size > SIZE_MAX / count) {
    arena->failed = true;
    return NULL;
  }
  void *memory = kg_arena_take(arena, count * size, ALIGNMENT);
  if (memory) {
    memset(memory, 0, count * size);
  }
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

kg_arena_mark kg_arena_mark_of(const kg_arena *arena)
{
  return (kg_arena_mark){arena->last, arena->last ? arena->last->used : 0};
}

void kg_arena_rewind(kg_arena *arena, kg_arena_mark mark)
{
  while (arena->last != mark.last) {
    kg_arena_block *block = arena->last;
    arena->last = block->previous;
    block->previous = arena->spare; /* the oldest ends up first, to be reused in the same order */
    arena->spare = block;
  }
  if (arena->last) {
    arena->last->used = mark.used;
  }
  arena->failed = false;
}

static size_t chain_bytes(const kg_arena_block *block)
{
  size_t bytes = 0;
  for (; block; block = block->previous) {
    bytes += block->bytes;
  }
  return bytes;
}

size_t kg_arena_bytes(const kg_arena *arena)
{
  return chain_bytes(arena->last) + chain_bytes(arena->spare);
}

static void free_chain(const kg_allocator *allocator, kg_arena_block *block)
{
  while (block) {
    kg_arena_block *previous = block->previous;
    give_back(allocator, block, block->bytes);
    block = previous;
  }
}

void kg_arena_release(kg_arena *arena)
{
  free_chain(arena->allocator, arena->last);
  free_chain(arena->allocator, arena->spare);
  arena->last = arena->spare = NULL;
  arena->failed = false;
}

/* Entry for files: the content decides the format, not the extension. */
#include "mocap/mocap.h"

#include "base/read_file.h"

#include <string.h>

kg_clip_def kg_clip_default_def(void)
{
  return (kg_clip_def){.up = KG_UP_Y};
}

static bool starts_like_amc(kg_text text)
{
  while (!kg_text_at_end(&text) && *text.at == '#') {
    kg_text_skip_line(&text);
    kg_text_skip_blank(&text);
  }
  return !kg_text_at_end(&text) && (*text.at == ':' || kg_word_is(kg_text_peek(&text), "1"));
}

static kg_status read_content(kg_clip **clip, const char *content, size_t length, const char *path,
                              const kg_clip_def *def, kg_error *error)
{
  kg_text text = kg_text_make(content, length, path);
  kg_text_skip_blank(&text);
  if (kg_text_at_end(&text)) {
    return kg_fail(error, KG_ERR_FORMAT, path, 1, 1,
                   "the file is empty, expected HIERARCHY (BVH) or ':' (AMC)");
  }
  if (kg_word_is(kg_text_peek(&text), "HIERARCHY")) {
    return kg_clip_read_bvh_text(clip, content, length, path, def, error);
  }
  if (starts_like_amc(text)) {
    return kg_clip_read_amc(clip, content, length, path, def, error);
  }
  return kg_text_fail(&text, error, "HIERARCHY (BVH) or a line with ':' or '#' (AMC)");
}

kg_status kg_clip_read(kg_clip **clip, const char *path, const kg_clip_def *def, kg_error *error)
{
  *clip = NULL;
  kg_arena arena;
  kg_arena_init(&arena, def->allocator);
  char *content;
  size_t length;
  kg_status status = kg_read_file(&content, &length, &arena, path, error);
  if (status == KG_OK) {
    status = read_content(clip, content, length, path, def, error);
  }
  kg_arena_release(&arena);
  return status;
}

/* json_get FILE [PATH...]: prints the values at the paths on one line, tabs between. A path is keys
 * and array indices with dots: capture.slip_m, frames.frame.47. With no path only checks that FILE
 * is JSON. Exit 1 when it is not, or a path leads nowhere. For the tests that are shell scripts. */
#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const json_t *find(const json_t *value, const char *path)
{
  while (value && *path) {
    char key[128];
    const size_t length = strcspn(path, ".");
    snprintf(key, sizeof key, "%.*s", (int)length, path);
    value = json_is_array(value) ? json_array_get(value, (size_t)strtoul(key, NULL, 10))
                                 : json_object_get(value, key);
    path += length + (path[length] == '.');
  }
  return value;
}

int main(int argc, char **argv)
{
  json_error_t error = {.text = "no file was named"};
  json_t *root = argc > 1 ? json_load_file(argv[1], JSON_REJECT_DUPLICATES, &error) : NULL;
  if (!root) {
    fprintf(stderr, "json_get: %d: %s\n", error.line, error.text);
    return 1;
  }
  int code = 0;
  for (int i = 2; i < argc && code == 0; i++) {
    const json_t *value = find(root, argv[i]);
    code = value ? 0 : 1;
    if (value) {
      json_dumpf(value, stdout, JSON_ENCODE_ANY | JSON_REAL_PRECISION(17));
      putchar(i + 1 < argc ? '\t' : '\n');
    }
  }
  json_decref(root);
  return code;
}

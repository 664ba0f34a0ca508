/* JSON values for the reports. */
#include "cli/json.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "cli/messages.h"

static void *allocate(size_t bytes)
{
  void *memory = malloc(bytes);
  if (!memory) {
    cli_message("out of memory while writing the report");
    cli_outputs_discard();
    _Exit(CLI_OUTPUT);
  }
  return memory;
}

void cli_json_init(void)
{
  json_set_alloc_funcs(allocate, free);
}

json_t *cli_json_number(double value)
{
  return isfinite(value) ? json_real(value) : json_null();
}

json_t *cli_json_numbers(const double *values, int count)
{
  if (!values) {
    return json_null();
  }
  json_t *array = json_array();
  for (int i = 0; i < count; i++) {
    json_array_append_new(array, cli_json_number(values[i]));
  }
  return array;
}

json_t *cli_json_vec3(kg_vec3 a)
{
  const double values[3] = {a.x, a.y, a.z};
  return cli_json_numbers(values, 3);
}

void cli_json_set_number(json_t *object, const char *key, double value)
{
  json_object_set_new(object, key, cli_json_number(value));
}

void cli_json_set_integer(json_t *object, const char *key, long value)
{
  json_object_set_new(object, key, json_integer(value));
}

/* A file may hold bytes that are no UTF-8 (a joint name in Latin-1): each becomes '?'. */
json_t *cli_json_text(const char *text)
{
  json_t *value = json_string(text);
  if (value) {
    return value;
  }
  char plain[1024];
  snprintf(plain, sizeof plain, "%s", text);
  for (char *c = plain; *c; c++) {
    *c = (unsigned char)*c < 0x80 ? *c : '?';
  }
  return json_string(plain);
}

void cli_json_set_text(json_t *object, const char *key, const char *text)
{
  json_object_set_new(object, key, text ? cli_json_text(text) : json_null());
}

void cli_json_set_bool(json_t *object, const char *key, bool value)
{
  json_object_set_new(object, key, json_boolean(value));
}

json_t *cli_json_report(const char *command)
{
  json_t *root = json_object();
  cli_json_set_integer(root, "schema", 1);
  cli_json_set_text(root, "kinegrad", KG_VERSION);
  cli_json_set_text(root, "command", command);
  return root;
}

bool cli_json_is_stdout(const char *path)
{
  return path && strcmp(path, "-") == 0;
}

bool cli_json_open(cli_output **output, const char *path)
{
  *output = NULL;
  if (!path || cli_json_is_stdout(path)) {
    return true;
  }
  *output = cli_outputs_open(path);
  return *output != NULL;
}

static int put(const char *buffer, size_t size, void *stream)
{
  return fwrite(buffer, 1, size, stream) == size ? 0 : -1;
}

/* One line per key; objects down to two levels are spread, what is inside is one line. */
static void dump(json_t *value, int level, FILE *stream)
{
  if (!json_is_object(value) || level > 2 || json_object_size(value) == 0) {
    json_dump_callback(value, put, stream, JSON_ENCODE_ANY | JSON_REAL_PRECISION(17));
    return;
  }
  const char *key;
  json_t *item;
  const char *separator = "{\n";
  json_object_foreach(value, key, item)
  {
    fprintf(stream, "%s%*s\"%s\": ", separator, level, "", key);
    dump(item, level + 1, stream);
    separator = ",\n";
  }
  fprintf(stream, "\n%*s}", level - 1, "");
}

bool cli_json_write(json_t *root, cli_output *output, FILE *out)
{
  FILE *stream = output ? cli_output_stream(output) : out;
  if (!stream) {
    return false;
  }
  dump(root, 1, stream);
  fputc('\n', stream);
  return output ? cli_output_close(output, stream) : true;
}

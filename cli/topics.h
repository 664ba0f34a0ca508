/* Pages of `kinegrad help <topic>`. A new one is a row in topics.c. */
#ifndef CLI_TOPICS_H
#define CLI_TOPICS_H

#include <stdio.h>

typedef struct cli_topic {
  const char *name;
  void (*print)(FILE *out);
} cli_topic;

extern const cli_topic cli_topics[];
extern const int cli_topic_count;

#endif

/* Numbers of binary files, byte by byte: the same on every machine. Internal to sdf/. */
#ifndef KG_SDF_BYTES_H
#define KG_SDF_BYTES_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* of up to eight bytes; the least significant first, or last */
static inline uint64_t bytes_value(const void *from, int count, bool is_last)
{
  const unsigned char *bytes = from;
  uint64_t value = 0;
  for (int k = 0; k < count; k++) {
    value = value << 8 | bytes[is_last ? k : count - 1 - k];
  }
  return value;
}

static inline uint64_t bytes_little(const void *from, int count)
{
  return bytes_value(from, count, false);
}

static inline void bytes_put_little(unsigned char *to, uint64_t value, int count)
{
  for (int k = 0; k < count; k++) {
    to[k] = (unsigned char)(value >> (8 * k));
  }
}

static inline float bytes_float(uint64_t value)
{
  const uint32_t bits = (uint32_t)value;
  float out;
  memcpy(&out, &bits, sizeof out);
  return out;
}

static inline double bytes_double(uint64_t bits)
{
  double out;
  memcpy(&out, &bits, sizeof out);
  return out;
}

#endif

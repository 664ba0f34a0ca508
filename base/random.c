/* xoshiro256++ 1.0 with a splitmix64 seed (Blackman and Vigna 2021). */
#include "kinegrad/random.h"

#include <math.h>

static uint64_t rotated_left(uint64_t x, int k)
{
  return (x << k) | (x >> (64 - k));
}

kg_random kg_random_make(uint64_t seed)
{
  kg_random random;
  for (int i = 0; i < 4; i++) {
    seed += UINT64_C(0x9e3779b97f4a7c15);
    uint64_t z = seed;
    z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
    random.s[i] = z ^ (z >> 31);
  }
  return random;
}

uint64_t kg_random_bits(kg_random *random)
{
  uint64_t *s = random->s;
  const uint64_t result = rotated_left(s[0] + s[3], 23) + s[0];
  const uint64_t t = s[1] << 17;
  s[2] ^= s[0];
  s[3] ^= s[1];
  s[1] ^= s[2];
  s[0] ^= s[3];
  s[2] ^= t;
  s[3] = rotated_left(s[3], 45);
  return result;
}

double kg_random_uniform(kg_random *random)
{
  return (double)(kg_random_bits(random) >> 11) * 0x1p-53;
}

double kg_random_normal(kg_random *random)
{
  for (;;) {
    const double u = 2.0 * kg_random_uniform(random) - 1.0;
    const double v = 2.0 * kg_random_uniform(random) - 1.0;
    const double s = u * u + v * v;
    if (s > 0.0 && s < 1.0) {
      return u * sqrt(-2.0 * log(s) / s);
    }
  }
}

/* kinegrad/random.h - small reproducible random numbers: same seed, same stream, any machine.
 *
 * xoshiro256++ of D. Blackman and S. Vigna, Scrambled linear pseudorandom number generators,
 * ACM TOMS 47 (2021), seeded through splitmix64. Not for cryptography. */
#ifndef KINEGRAD_RANDOM_H
#define KINEGRAD_RANDOM_H

#include "kinegrad/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct kg_random {
  uint64_t s[4];
} kg_random;

KG_API kg_random kg_random_make(uint64_t seed);
KG_API uint64_t kg_random_bits(kg_random *random);
/* Uniform in [0, 1). */
KG_API double kg_random_uniform(kg_random *random);
/* Normal with mean 0 and standard deviation 1 (Marsaglia's polar method). */
KG_API double kg_random_normal(kg_random *random);

#ifdef __cplusplus
}
#endif
#endif

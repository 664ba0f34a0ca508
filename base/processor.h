/* Which of the instruction sets that kernels are compiled for this processor runs. */
#ifndef BASE_PROCESSOR_H
#define BASE_PROCESSOR_H

/* 1: any processor; 2: x86-64-v3 (AVX2); 3: x86-64-v4 (AVX-512). */
int kg_processor_level(void);

#endif

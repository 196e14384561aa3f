/* What the sources of this folder share. All arrays are float32 unless stated otherwise, rows contiguous. */
#ifndef TORCHVTS_KERNELS_H
#define TORCHVTS_KERNELS_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Loops that the compiler vectorises are built once per kind of processor; the loader of the library picks. */
#if defined(WIDE)
#elif defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define WIDE
#endif

/* Products and sums rounded once, where the processor can, as torch's own loops do for some operators. */
#if defined(__GNUC__) && !defined(__clang__)
#define FUSED __attribute__((optimize("fp-contract=fast")))
#else
#define FUSED
#endif

/* Before a loop whose turns touch different places. */
#if defined(__clang__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define INDEPENDENT _Pragma("GCC ivdep")
#else
#define INDEPENDENT
#endif

/* Memory that the library keeps from call to call, in place of the system's: see memory.c. */
void *kept_memory(size_t size);
void *kept_zeros(size_t count, size_t size);
void give_back(void *memory);

#ifndef TORCHVTS_MEMORY
#define malloc(size) kept_memory(size)
#define calloc(count, size) kept_zeros(count, size)
#define free(memory) give_back(memory)
#endif

static inline int least(int a, int b) { return a < b ? a : b; }

#endif

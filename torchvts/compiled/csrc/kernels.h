/* What the sources of this folder share. All arrays are float32 unless stated otherwise, rows contiguous. */
#ifndef TORCHVTS_KERNELS_H
#define TORCHVTS_KERNELS_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Loops that the compiler vectorises are built once per kind of processor; the loader of the library picks. VECTOR: bytes of the widest vectors. */
#if !defined(WIDE) && defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
enum { VECTOR = 64 };
#else
#ifndef WIDE
#define WIDE
#endif
enum { VECTOR = 16 };
#endif

/* Products and sums rounded once, where the processor can, as torch's own loops do for some operators. */
#if defined(__GNUC__) && !defined(__clang__)
#define FUSED __attribute__((optimize("fp-contract=fast")))
#else
#define FUSED
#endif

/* Before a loop whose turns touch different places, and one of a few turns within another that is to be vectorised. */
#if defined(__clang__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#define UNROLLED _Pragma("unroll")
#elif defined(__GNUC__)
#define INDEPENDENT _Pragma("GCC ivdep")
#define UNROLLED _Pragma("GCC unroll 32")
#else
#define INDEPENDENT
#define UNROLLED
#endif

/* Has the processor fetch a line of memory that will be read soon. */
#if defined(__GNUC__)
#define FETCH(address) __builtin_prefetch(address)
#else
#define FETCH(address) (void)(address)
#endif


static inline int least(int a, int b) { return a < b ? a : b; }

/* Four of eight values, which may lie anywhere in memory, by their places. */
typedef float Four __attribute__((vector_size(16), aligned(4), may_alias));
#if defined(__clang__)
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
typedef int32_t Places __attribute__((vector_size(16)));
#define PICK(a, b, ...) __builtin_shuffle(a, b, (Places){__VA_ARGS__})
#endif

/* to[j][i] = from[i][j] of 4 x 4 values. */
static inline void transpose(const float *from, size_t from_step, float *to, size_t to_step) {
    const Four a = *(const Four *)from, b = *(const Four *)(from + from_step);
    const Four c = *(const Four *)(from + 2 * from_step), d = *(const Four *)(from + 3 * from_step);
    const Four left = PICK(a, b, 0, 4, 1, 5), right = PICK(a, b, 2, 6, 3, 7), more_left = PICK(c, d, 0, 4, 1, 5), more_right = PICK(c, d, 2, 6, 3, 7);
    *(Four *)to = PICK(left, more_left, 0, 1, 4, 5), *(Four *)(to + to_step) = PICK(left, more_left, 2, 3, 6, 7);
    *(Four *)(to + 2 * to_step) = PICK(right, more_right, 0, 1, 4, 5), *(Four *)(to + 3 * to_step) = PICK(right, more_right, 2, 3, 6, 7);
}

/* dark_below() of torchvts/core/noise.py: whether a channel of such intensity is dark, where the flat skin has `flat`. */
static inline int is_dark(float intensity, float flat, float three_noises) {
    return (intensity < three_noises) & (intensity < 0.5f * flat) & (flat > three_noises);
}

#endif

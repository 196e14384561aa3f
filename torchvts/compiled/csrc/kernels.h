/* What the sources of this folder share. All arrays are float32 unless stated otherwise, rows contiguous. */
#ifndef TORCHVTS_KERNELS_H
#define TORCHVTS_KERNELS_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(__SSE__)
#include <xmmintrin.h>
#endif

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

/* to[j][i] = from[i][j] of 4 x 4 values. */
static inline void transpose(const float *from, size_t from_step, float *to, size_t to_step) {
#if defined(__SSE__)
    __m128 a = _mm_loadu_ps(from), b = _mm_loadu_ps(from + from_step), c = _mm_loadu_ps(from + 2 * from_step), d = _mm_loadu_ps(from + 3 * from_step);
    _MM_TRANSPOSE4_PS(a, b, c, d);
    _mm_storeu_ps(to, a), _mm_storeu_ps(to + to_step, b), _mm_storeu_ps(to + 2 * to_step, c), _mm_storeu_ps(to + 3 * to_step, d);
#else
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) to[j * to_step + i] = from[i * from_step + j];
#endif
}

/* dark_below() of torchvts/core/noise.py: whether a channel of such intensity is dark, where the flat skin has `flat`. */
static inline int is_dark(float intensity, float flat, float three_noises) {
    return (intensity < three_noises) & (intensity < 0.5f * flat) & (flat > three_noises);
}

#endif

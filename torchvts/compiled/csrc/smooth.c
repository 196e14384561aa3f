/* A smooth change of the light over the image, divided out: torchvts/core/smooth.py, which explains it. */
#include "plan.h"

#include <stdlib.h>

enum { LANES = 8, TERMS = 6 };

/* LANES values that one instruction works on, which may lie anywhere in memory; and their bits. Of this type, all sums below stay in registers. */
typedef double Lanes __attribute__((vector_size(sizeof(double) * LANES), aligned(sizeof(double)), may_alias));
typedef int64_t Bits __attribute__((vector_size(sizeof(double) * LANES), aligned(sizeof(double)), may_alias));

static inline const Lanes *lanes_at(const double *values) { return (const Lanes *)values; }

/* What of the change (3, n) is not explained by the surface so far, weighted, times each term of place (TERMS, n): (3, TERMS). n is a multiple
   of LANES. In double, so that the order of the sums leaves no trace in the result. */
WIDE FUSED static void surface_sums(const double *restrict change, const double *restrict place, int n, const double *restrict found,
                                    double per_square, double *restrict sum) {
    const Lanes zero = {0.0};
    Lanes total[3 * TERMS];
    for (int k = 0; k < 3 * TERMS; k++) total[k] = zero;
    for (int first = 0; first < n; first += LANES) {
        Lanes term[TERMS], left[3];
        UNROLLED for (int k = 0; k < TERMS; k++) term[k] = *lanes_at(place + (size_t)k * n + first);
        UNROLLED for (int c = 0; c < 3; c++) {
            left[c] = *lanes_at(change + (size_t)c * n + first);
            UNROLLED for (int k = 0; k < TERMS; k++) left[c] -= found[c * TERMS + k] * term[k];
        }
        Lanes weight = 1.0 - (left[0] * left[0] + left[1] * left[1] + left[2] * left[2]) * per_square;
        weight = (Lanes)((weight > zero) & (Bits)(weight * weight));
        UNROLLED for (int c = 0; c < 3; c++) {
            left[c] *= weight;
            UNROLLED for (int k = 0; k < TERMS; k++) total[c * TERMS + k] += left[c] * term[k];
        }
    }
    for (int k = 0; k < 3 * TERMS; k++) {
        sum[k] = 0.0;
        for (int j = 0; j < LANES; j++) sum[k] += total[k][j];
    }
}

/* The coefficients (3, TERMS) of the change of an image. */
static int smooth_change(const Plan *plan, const float *image, float *coefficients) {
    const int samples = (int)(plan->smooth_rows * plan->smooth_columns), n = (int)plan->smooth_samples;
    double sum[3 * TERMS], found[3 * TERMS] = {0.0}, *change = calloc(3 * ((size_t)n + samples), sizeof(double));
    if (!change) return NO_MEMORY;
    float *means = (float *)(change + 3 * (size_t)n);
    sample(image, (int)plan->height, (int)plan->width, (int)plan->smooth_stride, 3, means);
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < samples; k++) change[(size_t)c * n + k] = (double)(means[(size_t)c * samples + k] - 1.0f);
    for (int step = 0; step < plan->smooth_steps; step++) {
        surface_sums(change, plan->smooth_place, n, found, plan->per_square[step], sum);
        for (int k = 0; k < 3 * TERMS; k++) found[k] += sum[k] / (double)samples;
    }
    for (int c = 0; c < 3; c++) {
        double largest = plan->most_smooth, most = 0.0;
        for (int k = 0; k < TERMS; k++) most += fabs(found[c * TERMS + k]) * plan->peaks[k];
        for (int k = 0; k < TERMS; k++) coefficients[c * TERMS + k] = (float)(found[c * TERMS + k] * (largest / (most > largest ? most : largest)));
    }
    free(change);
    return DONE;
}

/* A row without the surface, whose terms of degree 0 to 2 in x these are; once, twice: Legendre polynomials in x. */
static WIDE void over_row(float *values, const float *restrict once, const float *restrict twice, float constant, float slope, float bend, int n) {
    for (int x = 0; x < n; x++) {
        const float surface = constant + slope * once[x] + bend * twice[x];
        values[x] *= 1.0f - surface + surface * surface;
    }
}

int remove_smooth_change(const Plan *plan, float *ratio) {
    const int height = (int)plan->height, width = (int)plan->width;
    float all[3 * TERMS], *found = all;
    const int code = smooth_change(plan, ratio, all);
    for (int c = 0; c < 3 && code == DONE; c++, found += TERMS)
        for (int y = 0; y < height; y++, ratio += width) {
            const float once = plan->along_y[y], twice = plan->along_y[height + y];
            over_row(ratio, plan->along_x, plan->along_x + width, found[0] + found[2] * once + found[5] * twice, found[1] + found[4] * once, found[3], width);
        }
    return code;
}

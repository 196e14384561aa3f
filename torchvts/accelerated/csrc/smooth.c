/* A smooth change of the light over the image: the same results as torchvts/core/smooth.py, which explains them. */
#include "kernels.h"

#include <math.h>

enum { LANES = 8, TERMS = 6 };

/* How a smooth change of the light is found in images of a size. place: (6, samples), the surface's terms at rows * columns samples, then zeros up to
   a multiple of 16; along_x (2, width), along_y (2, height): Legendre polynomials of degree 1 and 2; per_square: of each step. */
typedef struct {
    int32_t height, width, stride, rows, columns, samples, steps;
    double most;
    const double *place;
    const float *along_x, *along_y;
    const double *per_square, *peaks;
} SmoothLight;

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

/* Change at the samples of an image (3, height, width): (3, n), zero beyond the samples that there are. */
static void sample_change(const SmoothLight *of, const float *image, float *means, double *change) {
    const int height = of->height, width = of->width, samples = of->rows * of->columns, n = of->samples, stride = of->stride;
    if (stride < 3) {
        for (int c = 0, at = 0; c < 3; c++)
            for (int y = stride / 2; y < height; y += stride)
                for (int x = stride / 2; x < width; x += stride) means[at++] = image[((size_t)c * height + y) * width + x];
    } else {
        grid_means(image, 3, height, width, stride, stride / 2 - 1, of->rows, of->columns, means);
    }
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < samples; k++) change[(size_t)c * n + k] = (double)(means[(size_t)c * samples + k] - 1.0f);
}

/* Coefficients of the change of images (frames, 3, height, width): (frames, 3, TERMS). Returns 1 where memory is short. */
EXPORT int smooth_change(const SmoothLight *of, const float *image, int frames, float *coefficients) {
    const int samples = of->rows * of->columns;
    double sum[3 * TERMS], *change = calloc(3 * ((size_t)of->samples + samples), sizeof(double));
    float *means = (float *)(change + 3 * (size_t)of->samples);
    if (!change) return 1;
    for (int b = 0; b < frames; b++, image += 3 * (size_t)of->height * of->width, coefficients += 3 * TERMS) {
        double found[3 * TERMS] = {0.0};
        sample_change(of, image, means, change);
        for (int step = 0; step < of->steps; step++) {
            surface_sums(change, of->place, of->samples, found, of->per_square[step], sum);
            for (int k = 0; k < 3 * TERMS; k++) found[k] += sum[k] / (double)samples;
        }
        for (int c = 0; c < 3; c++) {
            double largest = 0.0;
            for (int k = 0; k < TERMS; k++) largest += fabs(found[c * TERMS + k]) * of->peaks[k];
            for (int k = 0; k < TERMS; k++) coefficients[c * TERMS + k] = (float)(found[c * TERMS + k] * (of->most / (largest > of->most ? largest : of->most)));
        }
    }
    free(change);
    return 0;
}

/* A row without the surface, whose terms of degree 0 to 2 in x these are; once, twice: Legendre polynomials in x. */
WIDE static void over_row(const float *restrict values, const float *restrict once, const float *restrict twice, float constant, float slope,
                          float bend, int n, float *restrict result) {
    for (int x = 0; x < n; x++) {
        const float surface = constant + slope * once[x] + bend * twice[x];
        result[x] = values[x] * (1.0f - surface + surface * surface);
    }
}

/* Images (frames, 3, height, width) without the surface of their coefficients. */
EXPORT void over_smooth(const SmoothLight *of, const float *image, const float *found, int frames, float *result) {
    const int height = of->height, width = of->width;
    for (int plane = 0; plane < 3 * frames; plane++, found += TERMS)
        for (int y = 0; y < height; y++, image += width, result += width) {
            const float once = of->along_y[y], twice = of->along_y[height + y];
            over_row(image, of->along_x, of->along_x + width, found[0] + found[2] * once + found[5] * twice, found[1] + found[4] * once, found[3],
                     width, result);
        }
}

/* A smooth change of the light over the image: the same results as torchvts/core/smooth.py, which explains them. */
#include "kernels.h"

#include <math.h>

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

LightOfRow light_of_row(const SmoothLight *of, const float *found, int y) {
    const float once = of->along_y[y], twice = of->along_y[of->height + y];
    const LightOfRow row = {found[0] + found[2] * once + found[5] * twice, found[1] + found[4] * once, found[3]};
    return row;
}

WIDE static void over_line(const float *values, const float *restrict once, const float *restrict twice, int n, LightOfRow of, float *result) {
    INDEPENDENT for (int x = 0; x < n; x++) result[x] = without_light(of, values[x], once[x], twice[x]);
}

/* n values of row y of a channel, from column `first` on, without the surface of that channel's coefficients. */
void row_over_smooth(const SmoothLight *of, const float *found, int y, int first, int n, const float *values, float *result) {
    const float *along = of->along_x + first;
    over_line(values, along, along + of->width, n, light_of_row(of, found, y), result);
}

/* What over_smooth() is given. */
typedef struct {
    const SmoothLight *of;
    const float *image, *found;
    float *result;
} Surface;

/* Parts of a plane of which threads take one at a time. */
enum { PIECES = 2 };

static void over_lines(void *with, int part) {
    const Surface *work = with;
    const int height = work->of->height, width = work->of->width, plane = part / PIECES, piece = part % PIECES;
    for (int y = height * piece / PIECES; y < height * (piece + 1) / PIECES; y++) {
        const size_t line = ((size_t)plane * height + y) * width;
        row_over_smooth(work->of, work->found + (size_t)TERMS * plane, y, 0, width, work->image + line, work->result + line);
    }
}

/* Images (frames, 3, height, width) without the surface of their coefficients. */
EXPORT void over_smooth(const SmoothLight *of, const float *image, const float *found, int frames, float *result) {
    Surface work = {of, image, found, result};
    share(over_lines, &work, 3 * frames * PIECES);
}

/* From a camera's linear light to the compensated image: torchvts/compensate, which explains it. */
#include "plan.h"

#include <stdlib.h>

/* Means of 3 x 3 pixels, the first from (first, first) on and then every `stride`, of `planes` images: (planes, rows, columns). */
void grid_means(const float *image, int planes, int height, int width, int stride, int first, int rows, int columns, float *means) {
    for (int plane = 0; plane < planes; plane++, image += (size_t)height * width)
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < columns; j++) {
                const float *a = image + (size_t)(first + i * stride) * width + first + j * stride, *b = a + width, *c = b + width;
                *means++ = (a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + c[0] + c[1] + c[2]) / 9.0f;
            }
}

/* image * gain + offset, either of which may be null; without offset image * gain + pedestal * gain. */
WIDE static void multiply_add(const float *restrict image, const float *restrict gain, const float *restrict offset, float pedestal, int n,
                              float *restrict light) {
    if (gain && !offset && pedestal != 0.0f)
        for (int x = 0; x < n; x++) light[x] = image[x] * gain[x] + pedestal * gain[x];
    else if (gain && offset)
        for (int x = 0; x < n; x++) light[x] = image[x] * gain[x] + offset[x];
    else if (gain)
        for (int x = 0; x < n; x++) light[x] = image[x] * gain[x];
    else if (offset)
        for (int x = 0; x < n; x++) light[x] = image[x] + offset[x];
    else
        memcpy(light, image, sizeof(float) * (size_t)n);
}

/* The sum of an odd number of lines, each times its weight, in their order; seven, six and two at a time, which stay in registers. Fused, as
   torch adds a multiple. */
WIDE FUSED static void weighted_sum(const float *const *lines, const float *restrict weight, int taps, int n, float *restrict result) {
    int k = taps >= 7 ? 7 : 1;
    const float *l0 = lines[0], w0 = weight[0];
    if (taps < 7) {
        for (int x = 0; x < n; x++) result[x] = l0[x] * w0;
    } else {
        const float *l1 = lines[1], *l2 = lines[2], *l3 = lines[3], *l4 = lines[4], *l5 = lines[5], *l6 = lines[6];
        const float w1 = weight[1], w2 = weight[2], w3 = weight[3], w4 = weight[4], w5 = weight[5], w6 = weight[6];
        INDEPENDENT for (int x = 0; x < n; x++) {
            float sum = l0[x] * w0;
            sum += l1[x] * w1, sum += l2[x] * w2, sum += l3[x] * w3, sum += l4[x] * w4, sum += l5[x] * w5, sum += l6[x] * w6;
            result[x] = sum;
        }
    }
    for (; k + 6 <= taps; k += 6) {
        const float *l1 = lines[k], *l2 = lines[k + 1], *l3 = lines[k + 2], *l4 = lines[k + 3], *l5 = lines[k + 4], *l6 = lines[k + 5];
        const float w1 = weight[k], w2 = weight[k + 1], w3 = weight[k + 2], w4 = weight[k + 3], w5 = weight[k + 4], w6 = weight[k + 5];
        INDEPENDENT for (int x = 0; x < n; x++) {
            float sum = result[x];
            sum += l1[x] * w1, sum += l2[x] * w2, sum += l3[x] * w3, sum += l4[x] * w4, sum += l5[x] * w5, sum += l6[x] * w6;
            result[x] = sum;
        }
    }
    for (; k + 2 <= taps; k += 2) {
        const float *l1 = lines[k], *l2 = lines[k + 1], w1 = weight[k], w2 = weight[k + 1];
        INDEPENDENT for (int x = 0; x < n; x++) {
            float sum = result[x];
            sum += l1[x] * w1, sum += l2[x] * w2;
            result[x] = sum;
        }
    }
}

/* What is done to a plane: image * gain + offset, either of which may be null; where both frame and background are saturated, the model's light. */
typedef struct {
    const float *image, *gain, *offset, *model;
    float pedestal, saturated;
} Affine;

/* The model's light where it is known, which is where the background is saturated, and the image is so bright. */
static WIDE void restore(const float *restrict image, const float *restrict model, float saturated, size_t n, float *restrict light) {
    for (size_t k = 0; k < n; k++) light[k] = (image[k] >= saturated) & (model[k] > 0.0f) ? model[k] : light[k];
}

/* n values from `at` on. */
static void apply(const Affine *of, size_t at, int n, float *light) {
    multiply_add(of->image + at, of->gain ? of->gain + at : NULL, of->offset ? of->offset + at : NULL, of->pedestal, n, light);
    if (of->model) restore(of->image + at, of->model + at, of->saturated, (size_t)n, light);
}

/* Has the processor fetch what apply() will read: rows are too short for it to see by itself where they go on. */
static void ahead(const Affine *of, size_t at, int n) {
    for (int x = 0; x < n; x += 16) {
        FETCH(of->image + at + x);
        if (of->gain) FETCH(of->gain + at + x);
        if (of->offset) FETCH(of->offset + at + x);
    }
}

/* A plane blurred, its border repeated. scratch: taps lines, and one that is `taps` longer; `lines`: taps pointers. */
static void blur_lines(const Affine *plane, const float *weight, int taps, int height, int width, float *scratch, const float **lines, float *out) {
    const int reach = taps / 2;
    float *padded = scratch + (size_t)taps * width, *row = padded + reach;
    for (int y = 0, next = 0; y < height; y++) {
        for (; next < height && next <= y + reach; next++) { /* row `next` of the plane lies in line next % taps */
            const size_t at = (size_t)next * width;
            if (next + 1 < height) ahead(plane, at + width, width);
            apply(plane, at, width, row);
            for (int k = 0; k < reach; k++) padded[k] = row[0], row[width + k] = row[width - 1];
            for (int k = 0; k < taps; k++) lines[k] = padded + k;
            weighted_sum(lines, weight, taps, width, scratch + (size_t)(next % taps) * width);
        }
        for (int k = 0; k < taps; k++) {
            const int at = y + k - reach < 0 ? 0 : least(y + k - reach, height - 1);
            lines[k] = scratch + (size_t)(at % taps) * width;
        }
        weighted_sum(lines, weight, taps, width, out + (size_t)y * width);
    }
}

int blur_plane(const float *plane, const float *weight, int taps, int height, int width, float *out) {
    const Affine affine = {.image = plane};
    const float **line = malloc(sizeof(float *) * (size_t)taps + sizeof(float) * ((size_t)taps * width + width + taps));
    if (!line) return NO_MEMORY;
    blur_lines(&affine, weight, taps, height, width, (float *)(line + taps), line, out);
    free(line);
    return DONE;
}

/* Defective pixels of a plane become the mean of four others. */
static void fill(float *plane, const int64_t *defect, const int64_t *neighbours, int64_t count, float *scratch) {
    for (int64_t k = 0; k < count; k++, neighbours += 4)
        scratch[k] = (plane[neighbours[0]] + plane[neighbours[1]] + plane[neighbours[2]] + plane[neighbours[3]]) / 4.0f;
    for (int64_t k = 0; k < count; k++) plane[defect[k]] = scratch[k];
}

/* The bits of n floats to whole numbers of the same order, in which negative floats run backwards; and the ends of these. */
WIDE static void to_keys(uint32_t *bits, int n, uint32_t *lowest, uint32_t *highest) {
    uint32_t low = 0xffffffffu, high = 0;
    for (int k = 0; k < n; k++) {
        const uint32_t key = bits[k] ^ ((uint32_t)((int32_t)bits[k] >> 31) | 0x80000000u);
        low = key < low ? key : low;
        high = key > high ? key : high;
        bits[k] = key;
    }
    *lowest = low, *highest = high;
}

/* The inverse. */
WIDE static void from_keys(uint32_t *keys, int n) {
    for (int k = 0; k < n; k++) keys[k] ^= (uint32_t)~((int32_t)keys[k] >> 31) | 0x80000000u;
}

/* Sorts n values by the bits of their floats, at most twelve at a time; other: as many more. Returns where the sorted values lie. */
float *sorted(float *values, float *other, int n) {
    uint32_t counts[3][4096], *from = (uint32_t *)values, *to = (uint32_t *)other, low, high;
    to_keys(from, n, &low, &high);
    int bits = 0;
    while (bits < 32 && (high - low) >> bits) bits++;
    const int passes = bits > 24 ? 3 : bits > 12 ? 2 : 1, digit = (bits + passes - 1) / passes;
    const uint32_t most = (1u << digit) - 1u;
    for (int pass = 0; pass < passes; pass++) memset(counts[pass], 0, sizeof(uint32_t) << digit);
    for (int pass = 0; pass < passes; pass++)
        for (int k = 0; k < n; k++) counts[pass][(from[k] - low) >> (digit * pass) & most]++;
    for (int pass = 0; pass < passes; pass++) {
        uint32_t *count = counts[pass], total = 0;
        for (uint32_t k = 0; k <= most; k++) {
            const uint32_t here = count[k];
            count[k] = total;
            total += here;
        }
        for (int k = 0; k < n; k++) to[count[(from[k] - low) >> (digit * pass) & most]++] = from[k];
        uint32_t *swapped = from;
        from = to, to = swapped;
    }
    from_keys(from, n);
    return (float *)from;
}

enum { LANES = 16 };

/* The smallest of values[k + distance] - values[k] for k below n. */
WIDE static float narrowest(const float *restrict values, int distance, int n) {
    float least_of[LANES], found;
    int k = 0;
    for (int j = 0; j < LANES; j++) least_of[j] = values[distance] - values[0];
    for (; k + LANES <= n; k += LANES)
        for (int j = 0; j < LANES; j++) {
            const float width = values[k + j + distance] - values[k + j];
            least_of[j] = width < least_of[j] ? width : least_of[j];
        }
    found = least_of[0];
    for (; k < n; k++) found = values[k + distance] - values[k] < found ? values[k + distance] - values[k] : found;
    for (int j = 1; j < LANES; j++) found = least_of[j] < found ? least_of[j] : found;
    return found;
}

/* half_sample_mode() of torchvts/core/robust.py. */
static float half_sample_mode(const float *ordered, int n, int halvings) {
    for (; halvings > 0; halvings--) {
        const int half = (n + 1) / 2;
        const float width = narrowest(ordered, half - 1, n - half + 1);
        int start = 0;
        while (start < n - half && ordered[start + half - 1] - ordered[start] != width) start++;
        ordered += start;
        n = half;
    }
    return ordered[n / 2];
}

/* How many rows, or columns, are sampled of so many. */
static int sampled(int length, int stride) { return (length - stride / 2 + stride - 1) / stride; }

/* The mode of every stride-th pixel of a plane. some: twice as much memory as so many pixels. */
static float mode_of(const float *plane, int height, int width, int stride, int halvings, float *some) {
    int n = 0;
    for (int y = stride / 2; y < height; y += stride)
        for (int x = stride / 2; x < width; x += stride) some[n++] = plane[(size_t)y * width + x];
    return half_sample_mode(sorted(some, some + n, n), n, halvings);
}

/* How many of n samples (3, LINE) lie within `reach` of each of five levels in all three channels. */
enum { LINE = 128 };
WIDE static void count_near(float some[3][LINE], int n, const float level[5][3], float reach, int counts[5]) {
    for (int k = 0; k < 5; k++) {
        const float r = level[k][0], g = level[k][1], b = level[k][2];
        int count = 0;
        for (int j = 0; j < n; j++) count += (fabsf(some[0][j] - r) < reach) & (fabsf(some[1][j] - g) < reach) & (fabsf(some[2][j] - b) < reach);
        counts[k] += count;
    }
}

/* Drift.of_one_skin() of torchvts/compensate/drift.py: the drift of a frame, in place of what each channel by itself says. */
static void make_of_one_skin(const Plan *plan, const float *image, float *drift) {
    const int height = (int)plan->height, width = (int)plan->width, stride = (int)plan->drift_stride;
    const float least_drift = (float)plan->least_drift, reach = (float)(plan->same_skin * plan->least_drift);
    const float lowest = fminf(fminf(drift[0], drift[1]), drift[2]), highest = fmaxf(fmaxf(drift[0], drift[1]), drift[2]);
    const int columns = sampled(width, stride);
    float levels[5][3], some[3][LINE];
    int counts[5] = {0}, best = 0, most;
    if (highest - lowest < least_drift) return;
    for (int k = 0; k < 5; k++)
        for (int c = 0; c < 3; c++) levels[k][c] = k == 0 ? drift[c] : k < 4 ? drift[k - 1] : 0.0f;
    for (int y = stride / 2; y < height; y += stride)
        for (int first = 0; first < columns; first += LINE) {
            const int n = least(columns - first, LINE);
            for (int c = 0; c < 3; c++) {
                const float *row = image + ((size_t)c * height + y) * width + stride / 2 + (size_t)first * stride;
                for (int j = 0; j < n; j++) some[c][j] = row[(size_t)j * stride] - 1.0f;
            }
            count_near(some, n, levels, reach, counts);
        }
    most = (int)plan->more_skin * counts[0];
    for (int k = 1; k < 5; k++)
        if (100 * counts[k] > most) most = 100 * counts[k], best = k;
    for (int c = 0; c < 3; c++) drift[c] = levels[best][c];
}

/* Gain, offset, defects and blur of linear light. */
static int clean(const Plan *plan, const float *image, float *light) {
    const int taps = (int)plan->blur_taps, height = (int)plan->height, width = (int)plan->width;
    const size_t pixels = (size_t)height * width, lines = (size_t)taps * width + width + taps, filled = taps && plan->defects ? pixels : 0;
    const float **line = malloc(sizeof(float *) * (size_t)(taps + 1) + sizeof(float) * (lines + filled + (size_t)plan->defects + 1));
    if (!line) return NO_MEMORY;
    float *rows = (float *)(line + taps + 1), *whole = rows + lines, *repaired = whole + filled;
    for (int c = 0; c < 3; c++, image += pixels, light += pixels) {
        const size_t at = pixels * (size_t)c;
        Affine affine = {image, plan->gain ? plan->gain + at : NULL, plan->offset ? plan->offset + at : NULL,
                         plan->saturated_model ? plan->saturated_model + at : NULL, plan->pedestal[c], (float)plan->saturation_light};
        if (plan->defects || !taps) {
            float *to = filled ? whole : light;
            apply(&affine, 0, (int)pixels, to);
            if (plan->defects) fill(to, plan->defect, plan->neighbours, plan->defects, repaired);
            affine = (Affine){.image = to};
        }
        if (taps) blur_lines(&affine, plan->blur, taps, height, width, rows, line, light);
    }
    free(line);
    return DONE;
}

/* Drift.by_mode(): the levels of the channels. */
static int by_mode(const Plan *plan, const float *light, float *level) {
    const int height = (int)plan->height, width = (int)plan->width, stride = (int)plan->drift_stride;
    const size_t pixels = (size_t)height * width;
    const float most = (float)plan->most_drift, least_drift = (float)plan->least_drift;
    float *some = malloc(2 * sizeof(float) * (size_t)sampled(height, stride) * sampled(width, stride)), largest = 0.0f;
    if (!some) return NO_MEMORY;
    for (int c = 0; c < 3; c++) {
        const float drift = mode_of(light + pixels * c, height, width, stride, (int)plan->halvings, some) - 1.0f;
        level[c] = drift < -most ? -most : drift > most ? most : drift;
    }
    free(some);
    make_of_one_skin(plan, light, level);
    for (int c = 0; c < 3; c++) largest = fabsf(level[c]) > largest ? fabsf(level[c]) : largest;
    float weight = largest / least_drift - 1.0f;
    weight = weight < 0.0f ? 0.0f : weight > 1.0f ? 1.0f : weight;
    for (int c = 0; c < 3; c++) level[c] = 1.0f + weight * level[c];
    return DONE;
}

int samples_along(int length, int stride) { return stride < 3 ? sampled(length, stride) : length / stride; }

void sample(const float *image, int height, int width, int stride, int planes, float *means) {
    const int rows = samples_along(height, stride), columns = samples_along(width, stride);
    if (stride > 2) {
        grid_means(image, planes, height, width, stride, stride / 2 - 1, rows, columns, means);
        return;
    }
    for (int c = 0; c < planes; c++)
        for (int y = stride / 2; y < height; y += stride)
            for (int x = stride / 2; x < width; x += stride) *means++ = image[((size_t)c * height + y) * width + x];
}

/* Squared distances of samples from levels, in units of their variance, summed over the channels: (n); of one channel alone from 1, if it is given. */
static void squared(const Plan *plan, const float *ratio, const float *level, int one, int n, float *chi) {
    for (int k = 0; k < n; k++) chi[k] = 0.0f;
    for (int c = 0; c < 3; c++) {
        const float from = c == one ? 1.0f : level[c], *values = ratio + (size_t)c * n, *variance = plan->skin_variance + (size_t)c * n;
        for (int k = 0; k < n; k++) chi[k] += (values[k] - from) * (values[k] - from) / variance[k];
    }
}

static double likelihood(const float *chi, int n) {
    double sum = 0.0;
    for (int k = 0; k < n; k++) sum += (double)expf(-0.5f * chi[k]);
    return sum / n * 2.8284271247461903; /* a Gaussian in three channels has a mean of 2^(-3/2) */
}

/* The levels to which samples of undeformed skin are drawn: Drift.by_statistics() from its modes on. */
static void refine_levels(const Plan *plan, const float *ratio, int n, float *chi, float *level) {
    for (int pass = 0; pass < 2; pass++) {
        double sums[3] = {0.0}, weights[3] = {0.0};
        squared(plan, ratio, level, -1, n, chi);
        for (int k = 0; k < n; k++) {
            const float weight = expf(-0.5f * chi[k]);
            for (int c = 0; c < 3; c++) {
                const float here = weight / plan->skin_variance[(size_t)c * n + k];
                sums[c] += (double)(here * ratio[(size_t)c * n + k]), weights[c] += (double)here;
            }
        }
        for (int c = 0; c < 3; c++) level[c] = (float)(sums[c] / (weights[c] > 1e-12 ? weights[c] : 1e-12));
    }
    squared(plan, ratio, level, -1, n, chi);
    const double undeformed = likelihood(chi, n), share = undeformed > 0.5 ? plan->share_of_most : plan->share_of_few;
    float drift[3];
    int sure[3];
    for (int c = 0; c < 3; c++) {
        squared(plan, ratio, level, c, n, chi);
        drift[c] = fabsf(level[c] - 1.0f);
        sure[c] = drift[c] > (float)plan->least_level && drift[c] < (float)plan->most_level && undeformed > plan->least_skin &&
                  likelihood(chi, n) < share * undeformed;
    }
    for (int c = 0; c < 3; c++) level[c] = sure[c] ? level[c] : 1.0f;
}

/* Drift.by_statistics(): the levels of the channels. */
static int by_statistics(const Plan *plan, const float *light, float *level) {
    const int height = (int)plan->height, width = (int)plan->width, stride = (int)plan->drift_stride;
    const int n = samples_along(height, stride) * samples_along(width, stride);
    float *ratio = malloc(6 * sizeof(float) * (size_t)n), *some = ratio + 3 * (size_t)n, *chi = some + 2 * (size_t)n;
    if (!ratio) return NO_MEMORY;
    sample(light, height, width, stride, 3, ratio);
    int near = 1;
    for (int c = 0; c < 3; c++) {
        for (int k = 0; k < n; k++) some[k] = ratio[(size_t)c * n + k] /= plan->skin[(size_t)c * n + k];
        const float *ordered = sorted(some, some + n, n);
        near &= fabsf(ordered[(n - 1) / 2] - 1.0f) < 0.5f * (float)plan->least_level;
        level[c] = half_sample_mode(ordered, n, (int)plan->halvings);
    }
    if (near)
        level[0] = level[1] = level[2] = 1.0f;
    else
        refine_levels(plan, ratio, n, chi, level);
    free(ratio);
    return DONE;
}

static WIDE void divide_all(float *values, float by, size_t n) {
    for (size_t k = 0; k < n; k++) values[k] /= by;
}

/* Drift.forward(): the levels that light is divided by. */
static int levels_of(const Plan *plan, const float *light, float *level) {
    int code = plan->drifts == BY_STATISTICS ? by_statistics(plan, light, level) : by_mode(plan, light, level);
    if (code != DONE || plan->drifts != BY_MODE_FIRST) return code;
    int held = 0;
    for (int c = 0; c < 3; c++) held |= !(fabsf(level[c] - 1.0f) < (float)plan->most_by_mode);
    if (!held) return DONE;
    float far[3];
    code = by_statistics(plan, light, far);
    for (int c = 0; c < 3; c++) level[c] = fabsf(far[c] - 1.0f) > (float)plan->taken_over ? far[c] : level[c];
    return code;
}

int compensate(const Plan *plan, const float *image, float *light) {
    const size_t pixels = (size_t)plan->height * plan->width;
    int code = clean(plan, image, light);
    if (code != DONE || plan->drifts == NO_DRIFT) return code;
    float level[3];
    code = levels_of(plan, light, level);
    for (int c = 0; c < 3 && code == DONE; c++)
        if (level[c] != 1.0f) divide_all(light + pixels * c, level[c], pixels);
    if (plan->restores) restore(image, plan->saturated_model, (float)plan->saturation_light, 3 * pixels, light);
    return code;
}

/* From a camera's image to the compensated image: torchvts/compensate, which explains it. */
#include "plan.h"

/* Camera values in [0, 1] to linear light, by a table between whose entries light is a line. */
WIDE void linearise(const Plan *plan, const float *image, float *light) {
    const size_t n = 3 * (size_t)plan->height * plan->width;
    const float *table = plan->light_of, last = (float)(plan->lights - 1);
    for (size_t k = 0; k < n; k++) {
        const float at = image[k] * last;
        const int below = at < last - 1.0f ? (int)at : (int)last - 1;
        light[k] = table[below] + (at - (float)below) * (table[below + 1] - table[below]);
    }
}

/* (image + pedestal) * gain, which may be null for 1. */
WIDE static void multiply_add(const float *restrict image, const float *restrict gain, float pedestal, int n, float *restrict light) {
    if (gain)
        for (int x = 0; x < n; x++) light[x] = image[x] * gain[x] + pedestal * gain[x];
    else
        for (int x = 0; x < n; x++) light[x] = image[x] + pedestal;
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

/* What is done to a plane: (image + pedestal) * gain. */
typedef struct {
    const float *image, *gain;
    float pedestal;
} Affine;

/* n values from `at` on. */
static void apply(const Affine *of, size_t at, int n, float *light) {
    multiply_add(of->image + at, of->gain ? of->gain + at : NULL, of->pedestal, n, light);
}

/* Has the processor fetch what apply() will read: rows are too short for it to see by itself where they go on. */
static void ahead(const Affine *of, size_t at, int n) {
    for (int x = 0; x < n; x += 16) {
        FETCH(of->image + at + x);
        if (of->gain) FETCH(of->gain + at + x);
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

int blur_plane(Scratch *scratch, const float *plane, const float *weight, int taps, int height, int width, float *out) {
    const Affine affine = {.image = plane};
    const size_t before = scratch->used;
    const float **line = lend(scratch, sizeof(float *) * (size_t)taps + sizeof(float) * ((size_t)taps * width + width + taps));
    if (!line) return NO_MEMORY;
    blur_lines(&affine, weight, taps, height, width, (float *)(line + taps), line, out);
    give_back(scratch, before);
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

/* Light (height, width) in the light of the background; coefficients of its surface. Saturated pixels that seem darker than the background are it. */
static WIDE void relight(const Plan *plan, const float *image, const float *background, const float *terms, float *restrict light) {
    const int height = (int)plan->height, width = (int)plan->width;
    const float saturated = (float)plan->saturation_light, least_light = (float)plan->least_light, *once = plan->along_x, *twice = once + width;
    for (int y = 0; y < height; y++, image += width, background += width, light += width) {
        const float y1 = plan->along_y[y], y2 = plan->along_y[height + y], bend = terms[3];
        const float constant = terms[0] + terms[2] * y1 + terms[5] * y2, slope = terms[1] + terms[4] * y1;
        for (int x = 0; x < width; x++) {
            const float surface = constant + slope * once[x] + bend * twice[x], relit = image[x] / (surface > least_light ? surface : least_light);
            light[x] = (image[x] >= saturated) & ((relit < background[x]) | (background[x] >= saturated)) ? background[x] : relit;
        }
    }
}

int compensate(const Plan *plan, Scratch *scratch, const float *image, float *terms, float *light) {
    const int taps = (int)plan->blur_taps, height = (int)plan->height, width = (int)plan->width;
    const size_t pixels = (size_t)height * width, lines = (size_t)taps * width + width + taps, filled = taps && plan->defects ? pixels : 0;
    const size_t lit = plan->relights ? pixels : 0;
    const size_t before = scratch->used;
    const float **line = lend(scratch, sizeof(float *) * (size_t)(taps + 1) + sizeof(float) * (lines + lit + filled + (size_t)plan->defects + 1));
    if (!line) return NO_MEMORY;
    float *rows = (float *)(line + taps + 1), *relit = rows + lines, *whole = relit + lit, *repaired = whole + filled;
    const int code = plan->relights ? frame_light(plan, scratch, image, terms) : DONE;
    for (int c = 0; c < 3 && code == DONE; c++, image += pixels, light += pixels) {
        const size_t at = pixels * (size_t)c;
        if (lit) relight(plan, image, plan->background + at, terms + 6 * c, relit);
        Affine affine = {lit ? relit : image, plan->gain ? plan->gain + at : NULL, plan->pedestal[c]};
        if (plan->defects || !taps) {
            float *to = filled ? whole : light;
            apply(&affine, 0, (int)pixels, to);
            if (plan->defects) fill(to, plan->defect, plan->neighbours, plan->defects, repaired);
            affine = (Affine){.image = to};
        }
        if (taps) blur_lines(&affine, plan->blur, taps, height, width, rows, line, light);
    }
    give_back(scratch, before);
    return code;
}

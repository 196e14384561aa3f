/* The contact mask of compensated images: the same results as torchvts/contact/masks.py, which explains them. */
#include "bits.h"

#include <float.h>
#include <math.h>

/* The k-th smallest of n values, which it reorders: Hoare's selection. */
static float kth_of_few(float *values, int n, int k) {
    int low = 0, high = n - 1;
    while (low < high) {
        float pivot = values[low + (high - low) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot) i++;
            while (values[j] > pivot) j--;
            if (i <= j) {
                float swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            break;
    }
    return values[k];
}

/* The k-th smallest of n values, none of them negative, whose bits then have their order: the eleven highest bits leave a few. */
static float kth_smallest(const float *values, int n, int k, float *few) {
    uint16_t counts[2048] = {0};
    const uint32_t *bits = (const uint32_t *)values;
    if (n >= 65536) {
        memcpy(few, values, sizeof(float) * (size_t)n);
        return kth_of_few(few, n, k);
    }
    for (int i = 0; i < n; i++) counts[bits[i] >> 20]++;
    uint32_t bucket = 0;
    for (; k >= counts[bucket]; bucket++) k -= counts[bucket];
    int found = 0;
    for (int i = 0; i < n; i++) {
        few[found] = values[i];
        found += bits[i] >> 20 == bucket;
    }
    return kth_of_few(few, found, k);
}

/* The same, or what is no number if one of them is none. few: n + 1 floats. */
static float kth_or_none(const float *values, int n, int k, float *few) {
    int numbers = 1;
    for (int i = 0; i < n; i++) numbers &= values[i] <= FLT_MAX;
    return numbers ? kth_smallest(values, n, k, few) : NAN;
}

static float median(const float *values, int n, float *few) { return kth_or_none(values, n, (n - 1) / 2, few); }

enum { LANES = 16 };

/* Standard deviation of the values within three standard deviations; in double, so that the order of the sums leaves no trace. */
WIDE static float clipped_std(const float *restrict values, int n, float std) {
    double totals[LANES] = {0.0}, total = 0.0;
    const float most = 3.0f * std;
    int counts[LANES] = {0}, count = 0, k = 0;
    for (; k + LANES <= n; k += LANES)
        for (int j = 0; j < LANES; j++) {
            const float value = values[k + j];
            totals[j] += (double)(value <= most ? value * value : 0.0f);
            counts[j] += value <= most;
        }
    for (; k < n; k++) {
        total += (double)(values[k] <= most ? values[k] * values[k] : 0.0f);
        count += values[k] <= most;
    }
    for (int j = 0; j < LANES; j++) total += totals[j], count += counts[j];
    return (float)sqrt(total / (double)(count > 0 ? count : 1) / 0.97334);
}

/* The change of a pixel, in units of the calibrated noise. offset may be null: then the undeformed skin is 1. */
static inline float change_of(float image, const float *offset, float per_noise, size_t at) {
    return (offset ? offset[at] : -per_noise) + image * per_noise;
}

/* noise_from() of torchvts/core/noise.py, of the n second differences `some`. */
static float noise_from(const float *some, int n, float std) {
    std *= 1.5f;
    for (int pass = 0; pass < 2 && std == std; pass++) std = clipped_std(some, n, std);
    return std / sqrtf(1.5f);
}

/* noise_std() of torchvts/core/noise.py, of one channel's change. some: of so many samples, twice the memory, and one more. */
static float noise_of(const float *image, const float *offset, const float *per_noise, int height, int width, int stride, float *some) {
    int n = 0;
    for (int y = stride / 2; y < height; y += stride)
        for (int x = 0; x < width - 2; x += stride, n++) {
            const size_t i = (size_t)y * width + x;
            const float left = change_of(image[i], offset, per_noise[i], i), middle = change_of(image[i + 1], offset, per_noise[i + 1], i + 1);
            some[n] = fabsf(middle - 0.5f * (left + change_of(image[i + 2], offset, per_noise[i + 2], i + 2)));
        }
    return noise_from(some, n, median(some, n, some + n) / 0.6745f);
}

/* noise_of_spotted() of torchvts/core/noise.py, of images (frames, 3, height, width): noise (frames, 3). Returns 1 where memory is short. */
EXPORT int frame_noise(const float *image, int frames, int height, int width, int stride, float *noise) {
    const size_t samples = (size_t)((height + stride - 1) / stride) * ((width + stride - 1) / stride);
    float *some = malloc(sizeof(float) * (2 * samples + 1));
    if (!some) return 1;
    for (int k = 0; k < 3 * frames; k++, image += (size_t)height * width) {
        int n = 0;
        for (int y = stride / 2; y < height; y += stride)
            for (int x = 0; x < width - 2; x += stride) {
                const float *at = image + (size_t)y * width + x;
                some[n++] = fabsf(at[1] - 0.5f * (at[0] + at[2]));
            }
        noise[k] = noise_from(some, n, kth_or_none(some, n, n / 4, some + n) / 0.3186f);
    }
    free(some);
    return 0;
}

/* far_field() of torchvts/contact/masks.py, of one channel's change. */
static float far_field_of(const float *image, const float *offset, const float *per_noise, int height, int width, int stride, float *some) {
    int n = 0;
    for (int y = stride / 2; y < height; y += stride)
        for (int x = stride / 2; x < width; x += stride, n++) {
            const size_t i = (size_t)y * width + x;
            some[n] = fabsf(change_of(image[i], offset, per_noise[i], i));
            if (!(some[n] <= FLT_MAX)) return NAN;
        }
    float std = kth_smallest(some, n, n / 4, some + n) / 0.3186f;
    for (int pass = 0; pass < 2; pass++) std = clipped_std(some, n, std);
    return std;
}

/* A row of an image: its values, offset and 1 / noise, with the smooth change of its light, what a channel's change is multiplied by, and each
   column's sum of changes. offset[0] and `once` may be null. */
typedef struct {
    const float *values[3], *offset[3], *per_noise[3], *once, *twice;
    LightOfRow light[3];
    float scale[3], *sums[3];
} ChangeOfRow;

/* The changes of a row are added to its sums, their squares written to `squared`. Which arrays are null the callers know, so that the loop has no
   branch. */
static inline __attribute__((always_inline)) void add_changes(const ChangeOfRow *row, int smooth, int offsets, int n, float *restrict squared) {
    const ChangeOfRow of = *row;
    INDEPENDENT for (int x = 0; x < n; x++) {
        float total = 0.0f;
        UNROLLED for (int c = 0; c < 3; c++) {
            const float value = smooth ? without_light(of.light[c], of.values[c][x], of.once[x], of.twice[x]) : of.values[c][x];
            const float change = value * of.per_noise[c][x] + (offsets ? of.offset[c][x] : -of.per_noise[c][x]), scaled = change * of.scale[c];
            of.sums[c][x] += scaled;
            total += scaled * scaled;
        }
        squared[x] = total;
    }
}

WIDE static void add_change(const ChangeOfRow *row, int n, float *restrict squared) {
    if (row->once && row->offset[0])
        add_changes(row, 1, 1, n, squared);
    else if (row->once)
        add_changes(row, 1, 0, n, squared);
    else if (row->offset[0])
        add_changes(row, 0, 1, n, squared);
    else
        add_changes(row, 0, 0, n, squared);
}

WIDE static void above(const float *restrict values, float threshold, int width, uint8_t *restrict result) {
    for (int x = 0; x < width; x++) result[x] = values[x] > threshold;
}

WIDE static void either(const uint8_t *restrict a, const uint8_t *restrict b, const uint8_t *restrict c, int n, uint8_t *restrict result) {
    for (int x = 0; x < n; x++) result[x] = a[x] | b[x] | c[x];
}

WIDE static void all(const uint8_t *restrict a, const uint8_t *restrict b, const uint8_t *restrict c, int n, uint8_t *restrict result) {
    for (int x = 0; x < n; x++) result[x] = a[x] & b[x] & c[x];
}

WIDE static void keep_line(const uint8_t *restrict kept, const uint8_t *restrict inner, int n, uint8_t *restrict strong) {
    for (int x = 0; x < n; x++) strong[x] = (strong[x] & kept[x]) | inner[x];
}

WIDE static void add_bytes(const uint8_t *restrict values, int n, uint16_t *restrict sums) {
    for (int x = 0; x < n; x++) sums[x] = (uint16_t)(sums[x] + values[x]);
}

WIDE static void add_floats(const float *restrict values, int n, float *restrict sums) {
    for (int x = 0; x < n; x++) sums[x] += values[x];
}

typedef void (*combine)(const uint8_t *restrict, const uint8_t *restrict, const uint8_t *restrict, int, uint8_t *restrict);

/* Each pixel and its eight neighbours combined, of row y of an image; `beyond`: what lies outside of it. scratch: two lines, and two bytes. */
static void combine_row(const uint8_t *image, int height, int width, int y, combine how, uint8_t beyond, uint8_t *scratch, uint8_t *result) {
    uint8_t *column = scratch, *outside = scratch + width + 2;
    memset(outside, beyond, (size_t)width);
    const uint8_t *row = image + (size_t)y * width;
    column[0] = column[width + 1] = beyond;
    how(y > 0 ? row - width : outside, row, y < height - 1 ? row + width : outside, width, column + 1);
    how(column, column + 1, column + 2, width, result);
}

/* Rows `first` to `last` of an image of ones and zeros, closed: dilated by the eight neighbours, then eroded. scratch: (last - first + 4)
   (width + 2) bytes. */
static void close_rows(const uint8_t *image, int height, int width, int first, int last, uint8_t *scratch, uint8_t *closed) {
    uint8_t *dilated = scratch + 2 * ((size_t)width + 2);
    const int from = first > 0 ? first - 1 : 0, until = least(last + 1, height), rows = until - from;
    for (int y = from; y < until; y++) combine_row(image, height, width, y, either, 0, scratch, dilated + (size_t)(y - from) * width);
    for (int y = first; y < last; y++) {
        /* the first and the last row of what was dilated are the image's own border, or are not needed themselves */
        combine_row(dilated, rows, width, y - from, all, 1, scratch, closed + (size_t)y * width);
    }
}

/* Mean of every step-th pixel of an image, by four sums that do not wait for one another. */
static double mean_of(const float *image, int height, int width, int step) {
    double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
    int64_t count = 0;
    for (int y = step / 2; y < height; y += step) {
        const float *line = image + (size_t)y * width;
        int x = step / 2;
        for (; x + 3 * step < width; x += 4 * step, count += 4) a += line[x], b += line[x + step], c += line[x + 2 * step], d += line[x + 3 * step];
        for (; x < width; x += step, count++) a += line[x];
    }
    return (a + b + c + d) / (double)count;
}

/* Sums of `cell` values each, times `scale`, for n cells that lie side by side. */
#define SUMS(name, type, cell)                                                                                                          \
    WIDE static void name(const type *restrict values, float scale, int n, float *restrict sums) {                                        \
        for (int j = 0; j < n; j++) {                                                                                                   \
            type sum = values[j * (cell)];                                                                                              \
            for (int k = 1; k < (cell); k++) sum = (type)(sum + values[j * (cell) + k]);                                                 \
            sums[j] = (float)sum * scale;                                                                                               \
        }                                                                                                                               \
    }

SUMS(sums_1, float, 1)
SUMS(sums_3, float, 3)
SUMS(sums_6, float, 6)
SUMS(counts_1, uint16_t, 1)
SUMS(counts_3, uint16_t, 3)
SUMS(counts_6, uint16_t, 6)

/* The same of cells of any size; where the size is no multiple, the last one overlaps another. Divided, as torch does, by the area. */
static void cell_means(const float *values, int width, int cell, int columns, float *means) {
    const int whole = width / cell;
    if (cell == 1 || cell == 3 || cell == 6)
        (cell == 1 ? sums_1 : cell == 3 ? sums_3 : sums_6)(values, 1.0f, whole, means);
    for (int j = cell == 1 || cell == 3 || cell == 6 ? whole : 0; j < columns; j++) {
        const float *start = values + least(j * cell, width - cell);
        float sum = start[0];
        for (int k = 1; k < cell; k++) sum += start[k];
        means[j] = sum;
    }
    for (int j = 0; j < columns; j++) means[j] /= (float)(cell * cell);
}

static void cell_shares(const uint16_t *values, int width, int cell, int columns, float *shares) {
    const int whole = width / cell;
    if (cell == 1 || cell == 3 || cell == 6)
        (cell == 1 ? counts_1 : cell == 3 ? counts_3 : counts_6)(values, 1.0f, whole, shares);
    for (int j = cell == 1 || cell == 3 || cell == 6 ? whole : 0; j < columns; j++) {
        const uint16_t *start = values + least(j * cell, width - cell);
        int sum = 0;
        for (int k = 0; k < cell; k++) sum += start[k];
        shares[j] = (float)sum;
    }
    for (int j = 0; j < columns; j++) shares[j] /= (float)(cell * cell);
}

/* What one frame needs besides its masks: of cells, samples of each channel for each of two spreads, three mean changes, a share and then a weight each, and
   lines of both; masks of cells that have changed, faint ones among them, ones outside of any contact, kept ones, ones where cells decide, not pixels,
   ones of skin below the threshold; two masks for what is at hand, and a byte for each cell, twice. */
typedef struct {
    float *some, *means, *density, *down, *sums;
    uint64_t *changed, *faint, *outside, *kept, *solid, *tail, *one, *other;
    uint8_t *line, *other_line;
} Scratch;

/* The grid of coarse cells: their number, side, and how the model of ContactMask looks at them; least_square: of the least colour. */
typedef struct {
    int rows, columns, cell, reach;
    float least_cells;
    int bridge;
    float bridge_sigmas, tail_sigmas, least_spread, least_square;
    Shape shape;
} Grid;

/* A frame's images and what is found in it. scale: of each channel's change; raw: strong pixels, before they are closed. */
typedef struct {
    const float *image, *divided, *offset, *per_noise, *failed_below, *most_far_field;
    const SmoothLight *smooth;
    float *surface;
    int height, width, step, stride;
    float rounding, threshold, noise[6], scale[3], per[3], per_quarter[3];
    int works[3], bands;
    Grid grid;
    Scratch at;
    uint8_t *raw, *strong, *inner, *tail;
    atomic_int short_of_memory;
} Frame;

/* The noise of a channel's change, its far field, and whether its LED works. Part 3: a smooth change of the light, which has no part in the
   noise. */
static void find_noise(void *with, int c) {
    Frame *of = with;
    if (c == 3) {
        if (smooth_change(of->smooth, of->image, 1, of->surface)) of->short_of_memory = 1;
        return;
    }
    const size_t plane = (size_t)of->height * of->width * c;
    const float *image = of->image + plane, *offset = of->offset ? of->offset + plane : NULL, *per_noise = of->per_noise + plane;
    const size_t samples = (size_t)((of->height + of->stride - 1) / of->stride) * ((of->width + of->stride - 1) / of->stride);
    float *some = malloc(sizeof(float) * (2 * samples + 1));
    if (!some) {
        of->short_of_memory = 1;
        return;
    }
    of->noise[c] = noise_of(image, offset, per_noise, of->height, of->width, of->stride, some);
    of->noise[3 + c] = of->most_far_field[c] > 0.0f ? far_field_of(image, offset, per_noise, of->height, of->width, of->stride, some) : 0.0f;
    of->works[c] = !(mean_of(image, of->height, of->width, of->step) < of->failed_below[c]);
    free(some);
}

/* 1 over the standard deviation of each channel's change: its noise, or the far field if that is larger. 0 for one whose LED has failed; more than one
   dark channel is no failed LED. */
static void find_scale(Frame *of) {
    const int failed = 3 - of->works[0] - of->works[1] - of->works[2];
    for (int c = 0; c < 3; c++) {
        const float most = of->most_far_field[c];
        float noise = of->noise[c], far = of->noise[3 + c];
        if (far > most) far = most * most / far;
        if (!(far <= noise)) noise = far;
        if (noise < 1.0f) noise = 1.0f;
        of->scale[c] = failed == 1 && !of->works[c] ? 0.0f : 1.0f / sqrtf(noise * noise + of->rounding);
    }
}

/* Rows of cells of a band. */
static int first_row(const Frame *of, int band) { return of->grid.rows * band / of->bands; }

/* Pixels whose change stands out, and each cell's mean change; where the size is no multiple of the cell's side, the last cells overlap
   others. */
static void find_strong(void *with, int band) {
    Frame *of = with;
    const int cell = of->grid.cell, columns = of->grid.columns, height = of->height, width = of->width;
    const size_t pixels = (size_t)height * width, cells = (size_t)of->grid.rows * columns;
    float *sums = malloc(4 * sizeof(float) * (size_t)width), *squared = sums + 3 * (size_t)width;
    if (!sums) {
        of->short_of_memory = 1;
        return;
    }
    ChangeOfRow here = {.once = of->smooth ? of->smooth->along_x : NULL, .twice = of->smooth ? of->smooth->along_x + width : NULL};
    for (int i = first_row(of, band); i < first_row(of, band + 1); i++) {
        const int first = least(i * cell, height - cell);
        memset(sums, 0, 3 * sizeof(float) * (size_t)width);
        for (int y = first; y < first + cell; y++) {
            const size_t row = (size_t)y * width;
            for (int c = 0; c < 3; c++) {
                const size_t at = pixels * c + row;
                here.values[c] = of->divided + at, here.per_noise[c] = of->per_noise + at, here.offset[c] = of->offset ? of->offset + at : NULL;
                here.scale[c] = of->scale[c], here.sums[c] = sums + (size_t)c * width;
                if (of->smooth) here.light[c] = light_of_row(of->smooth, of->surface + 6 * c, y);
            }
            add_change(&here, width, squared);
            if (y >= i * cell) above(squared, of->threshold, width, of->raw + row); /* rows above are the cell's before, of another band maybe */
        }
        for (int c = 0; c < 3; c++) cell_means(sums + (size_t)c * width, width, cell, columns, of->at.means + c * cells + (size_t)i * columns);
    }
    free(sums);
}

/* Strong pixels closed, of the rows of a band's cells. */
static void close_strong(void *with, int band) {
    Frame *of = with;
    const int cell = of->grid.cell, height = of->height, width = of->width;
    const int first = first_row(of, band) * cell, last = least(first_row(of, band + 1) * cell, height);
    uint8_t *scratch = malloc((size_t)(last - first + 4) * (width + 2));
    if (!scratch) {
        of->short_of_memory = 1;
        return;
    }
    close_rows(of->raw, height, width, first, last, scratch, of->strong);
    free(scratch);
}

/* Each cell's share of strong pixels. */
static void find_shares(void *with, int band) {
    Frame *of = with;
    const int cell = of->grid.cell, columns = of->grid.columns, width = of->width;
    uint16_t *counts = malloc(sizeof(uint16_t) * (size_t)width);
    if (!counts) {
        of->short_of_memory = 1;
        return;
    }
    for (int i = first_row(of, band); i < first_row(of, band + 1); i++) {
        const int first = least(i * cell, of->height - cell);
        memset(counts, 0, sizeof(uint16_t) * (size_t)width);
        for (int y = first; y < first + cell; y++) add_bytes(of->strong + (size_t)y * width, width, counts);
        cell_shares(counts, width, cell, columns, of->at.density + (size_t)i * columns);
    }
    free(counts);
}

/* Cells of a row whose mean change, each channel's times its factor, is longer than `most`, as ones and zeros. */
WIDE static void longer_than(const float *restrict means, size_t cells, const float per[3], float most, int n, uint8_t *restrict result) {
    const float per_r = per[0], per_g = per[1], per_b = per[2];
    for (int j = 0; j < n; j++) {
        const float r = means[j] * per_r, g = means[cells + j] * per_g, b = means[2 * cells + j] * per_b;
        result[j] = r * r + g * g + b * b > most;
    }
}

/* Some thousand of a channel's mean changes, without their sign; returns their number. */
static int some_cells(const Grid *grid, const float *means, float *some) {
    const int rows = grid->rows, columns = grid->columns, longer = rows > columns ? rows : columns, shorter = rows + columns - longer;
    const int step = longer < 80 ? 1 : least(longer / 40, shorter); /* at least one line of a thin grid */
    int n = 0;
    for (int i = step / 2; i < rows; i += step)
        for (int j = step / 2; j < columns; j += step) some[n++] = fabsf(means[(size_t)i * columns + j]);
    return n;
}

/* 1 over the frame's own spread of a channel's mean changes: by their median, and for the tail by their lowest quarter, which
   a contact does not reach. */
static void find_spread(void *with, int part) {
    Frame *of = with;
    const Grid *grid = &of->grid;
    const int c = part % 3, by_quarter = part >= 3;
    const size_t cells = (size_t)grid->rows * grid->columns;
    float *some = of->at.some + part * (2 * cells + 1);
    const int n = some_cells(grid, of->at.means + c * cells, some);
    float std = by_quarter ? kth_or_none(some, n, n / 4, some + n) / 0.3186f : median(some, n, some + n) / 0.6745f;
    for (int pass = 0; pass < 2 && by_quarter; pass++) std = clipped_std(some, n, std);
    const float least_std = by_quarter ? grid->least_spread : 1.0f / (float)grid->cell;
    (by_quarter ? of->per_quarter : of->per)[c] = 1.0f / (std < least_std ? least_std : std);
}

/* Changed cells, with strong pixels, and faint ones, whose mean change stands out of the frame's own spread of such means; and what lies
   outside of them. Holes are neither changed nor outside. Returns whether any cell has changed. */
static int find_cells(const Grid *grid, const float per[3], Scratch at) {
    const size_t cells = (size_t)grid->rows * grid->columns;
    const int rows = grid->rows, columns = grid->columns, words = grid->shape.words;
    uint64_t found = 0;
    above(at.density, 0.0f, (int)cells, at.line);
    longer_than(at.means, cells, per, 25.0f, (int)cells, at.other_line);
    for (int i = 0; i < rows; i++) {
        const size_t first = (size_t)i * columns;
        uint64_t *changed = at.changed + (size_t)i * words, *faint = at.faint + (size_t)i * words;
        pack_bits(at.line + first, &grid->shape, changed);
        pack_bits(at.other_line + first, &grid->shape, faint);
        for (int w = 0; w < words; w++) faint[w] &= ~changed[w], changed[w] |= faint[w], found |= changed[w];
    }
    invert_bits(at.changed, &grid->shape, at.one);
    if (found) flood_from_border(at.one, &grid->shape, at.outside);
    return found != 0;
}

/* Weights of a row of cells, in place of shares of strong pixels. */
WIDE static void weigh(const uint8_t *restrict changed, const uint8_t *restrict faint, const uint8_t *restrict outside, float faint_weight, int n,
                       float *restrict weight) {
    for (int j = 0; j < n; j++) weight[j] = outside[j] ? 0.0f : faint[j] ? faint_weight : changed[j] ? weight[j] : 1.0f;
}

static int any_bit(const uint64_t *row, int words) {
    uint64_t any = 0;
    for (int w = 0; w < words; w++) any |= row[w];
    return any != 0;
}

/* Weights of row i; returns whether any may be other than zero: in most rows none is. */
static int weigh_row(const Grid *grid, Scratch at, float faint_weight, int i) {
    const int words = grid->shape.words;
    const size_t row = (size_t)i * words;
    float *weight = at.density + (size_t)i * grid->columns;
    uint8_t *outside = (uint8_t *)at.sums;
    if (!any_bit(at.one + row, words)) {
        memset(weight, 0, sizeof(float) * (size_t)grid->columns);
        return 0;
    }
    unpack_bits(at.changed + row, &grid->shape, at.line);
    unpack_bits(at.faint + row, &grid->shape, at.other_line);
    unpack_bits(at.outside + row, &grid->shape, outside);
    weigh(at.line, at.other_line, outside, faint_weight, grid->columns, weight);
    return 1;
}

/* Keeps what is connected to a cell around which there is nearly a disc of the least size. A hole counts as contact; faint cells too,
   but it takes three that lie together. */
static void keep_large(const Grid *grid, Scratch at) {
    const int rows = grid->rows, columns = grid->columns, reach = grid->reach, words = grid->shape.words;
    const float faint_weight = 0.4f * grid->least_cells < 1.0f ? 0.4f * grid->least_cells : 1.0f;
    const float *weight = at.density;
    int last = -1 - reach; /* the last row with weights that counts for row i */
    invert_bits(at.outside, &grid->shape, at.one);
    for (int i = 0; i < least(reach, rows); i++)
        if (weigh_row(grid, at, faint_weight, i)) last = i;
    for (int i = 0; i < rows; i++) {
        uint64_t *kept = at.kept + (size_t)i * words;
        if (i + reach < rows && weigh_row(grid, at, faint_weight, i + reach)) last = i + reach;
        if (last < i - reach) {
            memset(kept, 0, sizeof(uint64_t) * (size_t)words);
            continue;
        }
        memset(at.down, 0, sizeof(float) * (size_t)(columns + 2 * reach));
        for (int k = i - reach < 0 ? 0 : i - reach; k <= i + reach && k < rows; k++)
            add_floats(weight + (size_t)k * columns, columns, at.down + reach);
        memset(at.sums, 0, sizeof(float) * (size_t)columns);
        for (int k = 0; k <= 2 * reach; k++) add_floats(at.down + k, columns, at.sums);
        above(at.sums, grid->least_cells, columns, at.line);
        pack_bits(at.line, &grid->shape, kept);
        for (int w = 0; w < words; w++) kept[w] &= ~at.outside[(size_t)i * words + w];
    }
    flood(at.kept, at.one, &grid->shape);
}

/* Keeps the cells of at.other, among them all kept ones, and what they enclose. There cells decide. */
static void keep_filled(const Grid *grid, Scratch at) {
    invert_bits(at.other, &grid->shape, at.one);
    flood_from_border(at.one, &grid->shape, at.other);
    invert_bits(at.other, &grid->shape, at.one); /* what the border does not reach */
    for (size_t k = 0; k < words_of(&grid->shape); k++) {
        const uint64_t more = at.one[k] & ~at.kept[k];
        at.kept[k] |= more, at.faint[k] |= more, at.outside[k] &= ~more;
    }
}

/* Keeps cells between kept ones that have moved too, and what they enclose: a closing by a square. There cells decide. */
static void bridge_gaps(const Grid *grid, Scratch at) {
    static const float as_is[3] = {1.0f, 1.0f, 1.0f};
    const int rows = grid->rows, columns = grid->columns, words = grid->shape.words;
    const size_t cells = (size_t)rows * columns;
    uint64_t *unclosed = at.one, *moved = at.solid, added = 0;
    widen(at.kept, &grid->shape, grid->bridge, at.solid, at.other);
    invert_bits(at.other, &grid->shape, at.other);
    widen(at.other, &grid->shape, grid->bridge, at.solid, unclosed);
    for (int i = 0; i < rows; i++) {
        const size_t row = (size_t)i * words;
        for (int w = 0; w < words; w++) at.other[row + w] = ~unclosed[row + w] & ~at.kept[row + w] & (w == words - 1 ? grid->shape.last : ~UINT64_C(0));
        if (any_bit(at.other + row, words)) {
            longer_than(at.means + (size_t)i * columns, cells, as_is, grid->bridge_sigmas * grid->bridge_sigmas, columns, at.line);
            pack_bits(at.line, &grid->shape, moved);
        }
        for (int w = 0; w < words; w++) {
            const uint64_t more = at.other[row + w] & moved[w];
            at.other[row + w] = at.kept[row + w] | more, added |= more;
        }
    }
    if (added) keep_filled(grid, at);
}

/* Keeps the cells in which the skin of kept ones goes on, and what they enclose. There cells decide. */
static void keep_tail(const Grid *grid, const float per[3], Scratch at) {
    const int rows = grid->rows, columns = grid->columns, words = grid->shape.words;
    const size_t cells = (size_t)rows * columns;
    longer_than(at.means, cells, per, grid->tail_sigmas * grid->tail_sigmas, (int)cells, at.line);
    for (int i = 0; i < rows; i++) {
        const size_t row = (size_t)i * words;
        pack_bits(at.line + (size_t)i * columns, &grid->shape, at.one + row);
        for (int w = 0; w < words; w++) at.one[row + w] |= at.other[row + w] = at.kept[row + w];
    }
    flood(at.other, at.one, &grid->shape);
    for (size_t k = 0; k < words_of(&grid->shape); k++) at.tail[k] = at.kept[k];
    keep_filled(grid, at);
    for (size_t k = 0; k < words_of(&grid->shape); k++) at.tail[k] ^= at.kept[k];
}

/* Squares of each cell's mean change, relative: those of the light, at the least share that a colour has, and of the colour; of kept cells. */
static void find_colours(const Frame *of, float *light, float *colour) {
    const Grid *grid = &of->grid;
    const int rows = grid->rows, columns = grid->columns, cell = grid->cell, words = grid->shape.words;
    const size_t pixels = (size_t)of->height * of->width, cells = (size_t)rows * columns;
    for (int i = 0; i < rows; i++) {
        if (!any_bit(of->at.kept + (size_t)i * words, words)) continue;
        unpack_bits(of->at.kept + (size_t)i * words, &grid->shape, of->at.line);
        const size_t row = (size_t)(least(i * cell, of->height - cell) + cell / 2) * of->width;
        for (int j = 0; j < columns; j++) {
            if (!of->at.line[j]) continue;
            const size_t at = row + least(j * cell, of->width - cell) + cell / 2, k = (size_t)i * columns + j;
            float change[3];
            for (int c = 0; c < 3; c++) change[c] = of->at.means[c * cells + k] / (of->per_noise[c * pixels + at] * of->scale[c]);
            const float red = change[0] - change[1], blue = change[2] - change[1];
            light[k] = (change[0] * change[0] + change[1] * change[1] + change[2] * change[2]) / 3.0f * grid->least_square;
            colour[k] = (red * red + blue * blue) / 2.0f;
        }
    }
}

/* Whether the cells of a mask, kept ones, have the colour of slopes all together. */
static int coloured(const Grid *grid, const uint64_t *mask, const float *light, const float *colour, uint8_t *line) {
    const int words = grid->shape.words;
    float lights = 0.0f, colours = 0.0f;
    for (int i = 0; i < grid->rows; i++) {
        if (!any_bit(mask + (size_t)i * words, words)) continue;
        unpack_bits(mask + (size_t)i * words, &grid->shape, line);
        for (int j = 0; j < grid->columns; j++) {
            const size_t k = (size_t)i * grid->columns + j;
            if (line[j]) lights += light[k], colours += colour[k];
        }
    }
    return !(colours < lights);
}

/* Kept cells that have the colour themselves, to at.one; those among them around which there is nearly a disc of the least size, to at.other. */
static void find_own_colours(const Grid *grid, Scratch at, const float *light, const float *colour) {
    const int rows = grid->rows, columns = grid->columns, reach = grid->reach, words = grid->shape.words;
    for (int i = 0; i < rows; i++) {
        const uint64_t *kept = at.kept + (size_t)i * words;
        float *own = at.density + (size_t)i * columns;
        unpack_bits(kept, &grid->shape, at.line);
        for (int j = 0; j < columns; j++) {
            at.line[j] = at.line[j] && colour[(size_t)i * columns + j] >= light[(size_t)i * columns + j];
            own[j] = (float)at.line[j];
        }
        pack_bits(at.line, &grid->shape, at.one + (size_t)i * words);
    }
    for (int i = 0; i < rows; i++) {
        uint64_t *core = at.other + (size_t)i * words;
        memset(at.down, 0, sizeof(float) * (size_t)(columns + 2 * reach));
        for (int k = i - reach < 0 ? 0 : i - reach; k <= i + reach && k < rows; k++) add_floats(at.density + (size_t)k * columns, columns, at.down + reach);
        memset(at.sums, 0, sizeof(float) * (size_t)columns);
        for (int k = 0; k <= 2 * reach; k++) add_floats(at.down + k, columns, at.sums);
        above(at.sums, grid->least_cells, columns, at.line);
        pack_bits(at.line, &grid->shape, core);
        for (int w = 0; w < words; w++) core[w] &= at.one[(size_t)i * words + w];
    }
}

/* Keeps all cells if they have the colour of slopes all together, else those parts that have it, with what lies between them. Where an LED has
   failed, two channels are too few to say. */
static void keep_coloured(const Frame *of) {
    const Grid *grid = &of->grid;
    const Shape *shape = &grid->shape;
    const Scratch at = of->at;
    const size_t words = words_of(shape);
    float *light = at.some, *colour = at.some + (size_t)grid->rows * grid->columns;
    if (of->scale[0] <= 0.0f || of->scale[1] <= 0.0f || of->scale[2] <= 0.0f) return;
    find_colours(of, light, colour);
    if (coloured(grid, at.kept, light, colour, at.line)) return;
    find_own_colours(grid, at, light, colour);
    flood(at.other, at.one, shape);
    widen(at.other, shape, grid->bridge, at.solid, at.changed);
    invert_bits(at.changed, shape, at.changed);
    widen(at.changed, shape, grid->bridge, at.solid, at.one); /* what a closing leaves out */
    for (size_t k = 0; k < words; k++) at.other[k] |= at.kept[k] & ~at.one[k];
    invert_bits(at.other, shape, at.one);
    flood_from_border(at.one, shape, at.changed);
    for (size_t k = 0; k < words; k++) at.other[k] = at.kept[k] & ~at.changed[k];
    const int enough = coloured(grid, at.other, light, colour, at.line);
    for (size_t k = 0; k < words; k++) at.kept[k] = enough ? at.other[k] : 0, at.tail[k] &= at.kept[k];
}

/* Cells that decide for all their pixels: faint ones, and those none of whose neighbours lies outside of the contact; what is beyond the image
   counts as contact. */
static void find_solid(const Grid *grid, Scratch at) {
    widen(at.outside, &grid->shape, 1, at.one, at.other);
    for (size_t k = 0; k < words_of(&grid->shape); k++) at.solid[k] = at.kept[k] & (at.faint[k] | ~at.other[k]);
}

/* Each byte `cell` times. */
static void repeat(const uint8_t *bytes, int cell, int width, uint8_t *line) {
    for (int j = 0, first = 0; first < width; j++, first += cell) memset(line + first, bytes[j], (size_t)least(cell, width - first));
}

/* Strong pixels of kept cells, and all pixels of those that decide. */
static void to_pixels(void *with, int band) {
    Frame *of = with;
    const Shape *shape = &of->grid.shape;
    const int cell = of->grid.cell, height = of->height, width = of->width, words = shape->words;
    uint8_t *kept_line = malloc(3 * (size_t)width + 64 * (size_t)words), *solid_line = kept_line + width, *tail_line = solid_line + width;
    uint8_t *bytes = tail_line + width;
    if (!kept_line) {
        of->short_of_memory = 1;
        return;
    }
    for (int i = first_row(of, band); i < first_row(of, band + 1); i++) {
        const uint64_t *kept = of->at.kept + (size_t)i * words, *solid = of->at.solid + (size_t)i * words;
        uint64_t any = 0;
        for (int w = 0; w < words; w++) any |= kept[w];
        if (any) {
            unpack_bits(kept, shape, bytes);
            repeat(bytes, cell, width, kept_line);
            unpack_bits(solid, shape, bytes);
            repeat(bytes, cell, width, solid_line);
            unpack_bits(of->at.tail + (size_t)i * words, shape, bytes);
            repeat(bytes, cell, width, tail_line);
        }
        for (int y = i * cell; y < least((i + 1) * cell, height); y++) {
            const size_t row = (size_t)y * width;
            if (any) {
                keep_line(kept_line, solid_line, width, of->strong + row);
                memcpy(of->inner + row, solid_line, (size_t)width);
                memcpy(of->tail + row, tail_line, (size_t)width);
            } else {
                memset(of->strong + row, 0, (size_t)width);
                memset(of->inner + row, 0, (size_t)width);
                memset(of->tail + row, 0, (size_t)width);
            }
        }
    }
    free(kept_line);
}

/* Whether all values are far below what floats can hold: comparisons with NaN would let pixels through here that tensors do not. */
WIDE static int all_finite(const float *values, size_t n) {
    int all = 1;
    for (size_t k = 0; k < n; k++) all &= fabsf(values[k]) < 1e15f;
    return all;
}

/* Masks of one frame. Returns what contact_mask() does. */
static int mask_frame(Frame *of) {
    const size_t pixels = (size_t)of->height * of->width, cells = (size_t)of->grid.rows * of->grid.columns;
    share(find_noise, of, of->smooth ? 4 : 3);
    find_scale(of);
    if (of->short_of_memory) return 1;
    share(find_strong, of, of->bands);
    share(close_strong, of, of->bands);
    share(find_shares, of, of->bands);
    if (of->short_of_memory) return 1;
    const int finite = all_finite(of->at.means, 3 * cells);
    share(find_spread, of, of->grid.bridge > 0 ? 6 : 3);
    if (find_cells(&of->grid, of->per, of->at)) {
        keep_large(&of->grid, of->at);
        memset(of->at.tail, 0, sizeof(uint64_t) * words_of(&of->grid.shape));
        if (of->grid.bridge > 0) bridge_gaps(&of->grid, of->at), keep_tail(&of->grid, of->per_quarter, of->at);
        if (of->grid.least_square > 0.0f) keep_coloured(of);
        find_solid(&of->grid, of->at);
        share(to_pixels, of, of->bands);
    } else {
        memset(of->strong, 0, pixels);
        memset(of->inner, 0, pixels);
        memset(of->tail, 0, pixels);
    }
    return of->short_of_memory ? 1 : !finite ? 2 : 0;
}

/*
 * image (frames, 3, height, width), with offset and per_noise (3, height, width): change = image * per_noise + offset; offset
 * null where it is -per_noise. divided: image, or image without a smooth change of the light, which has no part in the noise. smooth:
 * null, or how to divide one out here; surface (frames, 3, 6) then takes its coefficients. Writes mask, inner and tail, bytes
 * (frames, height, width); inner is where cells decide, not pixels, tail where moved skin goes on below the threshold.
 * Returns 0, 1 where memory is short, or 2 where a value is not finite or its square would not be, and the masks mean nothing.
 */
EXPORT int contact_mask(const float *image, const float *divided, const float *offset, const float *per_noise, const float *failed_below,
                        const float *most_far_field, int frames, int height, int width, int step, int stride, int cell, int reach,
                        float sigmas, float rounding, float least_cells, int bridge, float bridge_sigmas, float tail_sigmas,
                        float least_spread, float least_colour, const SmoothLight *smooth, float *surface, uint8_t *mask, uint8_t *inner,
                        uint8_t *tail) {
    const int rows = (height + cell - 1) / cell, columns = (width + cell - 1) / cell;
    const Grid grid = {rows, columns, cell, reach, least_cells, bridge, bridge_sigmas, tail_sigmas, least_spread, least_colour * least_colour, shape_of(rows, columns)};
    const size_t pixels = (size_t)height * width, cells = (size_t)rows * columns, words = words_of(&grid.shape), line = 64 * (size_t)grid.shape.words;
    uint64_t *masks = malloc(8 * sizeof(uint64_t) * words + sizeof(float) * (16 * cells + 6 + 2 * line + 2 * (size_t)reach) + 2 * (cells + line));
    if (!masks) return 1;
    Scratch at = {.changed = masks, .faint = masks + words, .outside = masks + 2 * words, .kept = masks + 3 * words, .solid = masks + 4 * words};
    at.one = masks + 5 * words, at.other = masks + 6 * words, at.tail = masks + 7 * words;
    at.some = (float *)(masks + 8 * words), at.means = at.some + 12 * cells + 6, at.density = at.means + 3 * cells, at.sums = at.density + cells;
    at.down = at.sums + line, at.line = (uint8_t *)(at.down + line + 2 * reach), at.other_line = at.line + cells + line;
    int code = 0;
    for (int b = 0; b < frames && code != 1; b++) {
        Frame frame = {.image = image + 3 * pixels * b, .divided = divided + 3 * pixels * b, .offset = offset, .per_noise = per_noise, .failed_below = failed_below};
        frame.most_far_field = most_far_field, frame.height = height, frame.width = width, frame.step = step, frame.stride = stride;
        frame.smooth = smooth, frame.surface = smooth ? surface + 18 * b : NULL;
        frame.rounding = rounding, frame.threshold = sigmas * sigmas;
        frame.bands = least(rows, bands_of(height)), frame.grid = grid, frame.at = at;
        frame.raw = frame.inner = inner + pixels * b, frame.strong = mask + pixels * b, frame.tail = tail + pixels * b; /* cells decide after pixels are closed */
        const int found = mask_frame(&frame);
        code = found == 1 ? 1 : code | found;
    }
    free(masks);
    return code;
}

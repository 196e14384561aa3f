/* The contact mask of compensated images: the same results as torchvts/contact/masks.py, which explains them. */
#include "kernels.h"

#include <float.h>
#include <math.h>

/* Bits of a coarse cell. */
enum { CELL = 1, FAINT = 2, OUTSIDE = 4, KEPT = 8, ADDED = 16, REACHED = 32 };

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

/* The same for k in the middle, or what is no number if one of them is none. few: n + 1 floats. */
static float median(const float *values, int n, float *few) {
    int numbers = 1;
    for (int k = 0; k < n; k++) numbers &= values[k] <= FLT_MAX;
    return numbers ? kth_smallest(values, n, (n - 1) / 2, few) : NAN;
}

enum { LANES = 16 };

/* Standard deviation of the values within three standard deviations. */
WIDE static float clipped_std(const float *restrict values, int n, float std) {
    float totals[LANES] = {0.0f}, most = 3.0f * std, total = 0.0f;
    int counts[LANES] = {0}, count = 0, k = 0;
    for (; k + LANES <= n; k += LANES)
        for (int j = 0; j < LANES; j++) {
            const float value = values[k + j];
            totals[j] += value <= most ? value * value : 0.0f;
            counts[j] += value <= most;
        }
    for (; k < n; k++) {
        total += values[k] <= most ? values[k] * values[k] : 0.0f;
        count += values[k] <= most;
    }
    for (int j = 0; j < LANES; j++) total += totals[j], count += counts[j];
    return sqrtf(total / (float)(count > 0 ? count : 1) / 0.97334f);
}

/* The change of a pixel, in units of the calibrated noise. offset may be null: then the undeformed skin is 1. */
static inline float change_of(float image, const float *offset, float per_noise, size_t at) {
    return (offset ? offset[at] : -per_noise) + image * per_noise;
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
    float std = 1.5f * median(some, n, some + n) / 0.6745f;
    for (int pass = 0; pass < 2 && std == std; pass++) std = clipped_std(some, n, std);
    return std / sqrtf(1.5f);
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

/* One row of one channel: its change is added to `sums`, its square to `squared`. */
WIDE static void add_change(const float *restrict image, const float *restrict offset, const float *restrict per_noise, float scale, int width,
                            float *restrict sums, float *restrict squared) {
    if (offset)
        for (int x = 0; x < width; x++) {
            const float change = (offset[x] + image[x] * per_noise[x]) * scale;
            sums[x] += change;
            squared[x] += change * change;
        }
    else
        for (int x = 0; x < width; x++) {
            const float change = (image[x] * per_noise[x] - per_noise[x]) * scale;
            sums[x] += change;
            squared[x] += change * change;
        }
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

/* Each pixel and its eight neighbours combined, in place; `beyond` is what lies outside. `scratch`: (height + 3) (width + 2) bytes. */
static void combine_neighbours(uint8_t *image, int height, int width, combine how, uint8_t beyond, uint8_t *scratch) {
    uint8_t *padded = scratch, *lines = scratch + width + 2;
    memset(padded, beyond, (size_t)width + 2);
    memset(lines, beyond, (size_t)width);
    memset(lines + (size_t)(height + 1) * width, beyond, (size_t)width);
    for (int y = 0; y < height; y++) {
        memcpy(padded + 1, image + (size_t)y * width, (size_t)width);
        how(padded, padded + 1, padded + 2, width, lines + (size_t)(y + 1) * width);
    }
    for (int y = 0; y < height; y++) {
        const uint8_t *line = lines + (size_t)y * width;
        how(line, line + width, line + 2 * (size_t)width, width, image + (size_t)y * width);
    }
}

/* Marks all cells without any bit of `walls` that are connected, over edges, to those on the stack. */
static void spread(uint8_t *cells, int wide, uint8_t walls, uint8_t mark, int32_t *stack, int top) {
    const int way[4] = {1, -1, wide, -wide};
    while (top > 0) {
        int at = stack[--top];
        for (int k = 0; k < 4; k++) {
            int to = at + way[k];
            if (!(cells[to] & walls)) {
                cells[to] |= mark;
                stack[top++] = to;
            }
        }
    }
}

/* Whether an LED has failed: 1 for each channel that counts. More than one dark channel is no failed LED. */
static void working_leds(const float *image, const float *failed_below, int height, int width, int step, int works[3]) {
    int failed = 0;
    for (int c = 0; c < 3; c++) {
        double total[4] = {0.0}; /* four sums that do not wait for one another */
        int count = 0;
        for (int y = step / 2; y < height; y += step) {
            const float *line = image + ((size_t)c * height + y) * width;
            for (int x = step / 2; x < width; x += step, count++) total[count % 4] += line[x];
        }
        works[c] = !((total[0] + total[1] + total[2] + total[3]) / count < failed_below[c]);
        failed += !works[c];
    }
    if (failed != 1) works[0] = works[1] = works[2] = 1;
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

/* What one frame needs besides its masks. */
typedef struct {
    float *some, *means, *density, *down, *sums, *squared;
    uint8_t *state, *bytes;
    uint16_t *counts;
    int32_t *stack;
} Scratch;

/* The grid of coarse cells: their number, side, and how the model of ContactMask looks at them. */
typedef struct {
    int rows, columns, cell, reach;
    float least_cells;
    int bridge;
    float bridge_sigmas;
} Grid;

/* Pixels whose change stands out, closed, and each cell's share of them and mean change; where the size is no multiple of the cell's
   side, the last cells overlap others. */
static void find_strong(const float *frame, const float *offset, const float *per_noise, const float scale[3], int height, int width,
                        float threshold, Grid grid, Scratch at, uint8_t *strong) {
    const size_t pixels = (size_t)height * width, cells = (size_t)grid.rows * grid.columns;
    const int cell = grid.cell;
    for (int i = 0; i < grid.rows; i++) {
        const int first = least(i * cell, height - cell);
        memset(at.sums, 0, 3 * sizeof(float) * (size_t)width);
        for (int y = first; y < first + cell; y++) {
            const size_t row = (size_t)y * width;
            memset(at.squared, 0, sizeof(float) * (size_t)width);
            for (int c = 0; c < 3; c++)
                if (scale[c] != 0.0f)
                    add_change(frame + pixels * c + row, offset ? offset + pixels * c + row : NULL, per_noise + pixels * c + row, scale[c], width,
                               at.sums + (size_t)c * width, at.squared);
            above(at.squared, threshold, width, strong + row);
        }
        for (int c = 0; c < 3; c++)
            cell_means(at.sums + (size_t)c * width, width, cell, grid.columns, at.means + c * cells + (size_t)i * grid.columns);
    }
    combine_neighbours(strong, height, width, either, 0, at.bytes);
    combine_neighbours(strong, height, width, all, 1, at.bytes);
    for (int i = 0; i < grid.rows; i++) {
        const int first = least(i * cell, height - cell);
        memset(at.counts, 0, sizeof(uint16_t) * (size_t)width);
        for (int y = first; y < first + cell; y++) add_bytes(strong + (size_t)y * width, width, at.counts);
        cell_shares(at.counts, width, cell, grid.columns, at.density + (size_t)i * grid.columns);
    }
}

/* Cells with strong pixels, and faint ones, whose mean change stands out of the frame's own spread of such means. Holes are what
   then bears no OUTSIDE. The state has a border of one cell. Returns whether there is any cell. */
static int find_cells(Grid grid, Scratch at) {
    const size_t cells = (size_t)grid.rows * grid.columns;
    const int rows = grid.rows, columns = grid.columns, wide = columns + 2;
    const int longer = rows > columns ? rows : columns, shorter = rows + columns - longer;
    const int step = longer < 80 ? 1 : least(longer / 40, shorter); /* at least one line of a thin grid */
    const float least_std = 1.0f / (float)grid.cell;
    float per[3];
    for (int c = 0; c < 3; c++) {
        int n = 0;
        for (int i = step / 2; i < rows; i += step)
            for (int j = step / 2; j < columns; j += step) at.some[n++] = fabsf(at.means[c * cells + (size_t)i * columns + j]);
        const float std = median(at.some, n, at.some + n) / 0.6745f;
        per[c] = 1.0f / (std < least_std ? least_std : std);
    }
    memset(at.state, OUTSIDE, (size_t)(rows + 2) * wide);
    int found = 0, top = 0;
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) {
            const size_t k = (size_t)i * columns + j;
            const float r = at.means[k] * per[0], g = at.means[cells + k] * per[1], b = at.means[2 * cells + k] * per[2];
            const uint8_t kind = at.density[k] > 0.0f ? CELL : r * r + g * g + b * b > 25.0f ? CELL | FAINT : 0;
            const int place = (i + 1) * wide + j + 1;
            at.state[place] = kind;
            found |= kind;
            if (!kind && (i == 0 || j == 0 || i == rows - 1 || j == columns - 1)) {
                at.state[place] = OUTSIDE;
                at.stack[top++] = place;
            }
        }
    if (found) spread(at.state, wide, CELL | OUTSIDE, OUTSIDE, at.stack, top);
    return found;
}

/* Keeps what is connected to a cell around which there is nearly a disc of the least size. A hole counts as contact; faint cells too,
   but it takes three that lie together. */
static void keep_large(Grid grid, Scratch at) {
    const int rows = grid.rows, columns = grid.columns, wide = columns + 2, reach = grid.reach;
    const float faint_weight = 0.4f * grid.least_cells < 1.0f ? 0.4f * grid.least_cells : 1.0f;
    float *weight = at.density;
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) {
            const uint8_t kind = at.state[(i + 1) * wide + j + 1];
            float *w = weight + (size_t)i * columns + j;
            *w = kind & OUTSIDE ? 0.0f : kind & FAINT ? faint_weight : kind ? *w : 1.0f;
        }
    int top = 0;
    memset(at.down, 0, sizeof(float) * (size_t)(columns + 2 * reach));
    for (int i = 0; i < rows; i++) {
        memset(at.down + reach, 0, sizeof(float) * (size_t)columns);
        for (int k = i - reach < 0 ? 0 : i - reach; k <= i + reach && k < rows; k++)
            add_floats(weight + (size_t)k * columns, columns, at.down + reach);
        memset(at.sums, 0, sizeof(float) * (size_t)columns);
        for (int k = 0; k <= 2 * reach; k++) add_floats(at.down + k, columns, at.sums);
        for (int j = 0; j < columns; j++) {
            const int place = (i + 1) * wide + j + 1;
            if (at.sums[j] > grid.least_cells && !(at.state[place] & OUTSIDE)) {
                at.state[place] |= KEPT;
                at.stack[top++] = place;
            }
        }
    }
    spread(at.state, wide, OUTSIDE | KEPT, KEPT, at.stack, top);
}

/* Cells dilated by a square of so many cells either way; `lines` and `result`: bytes, as many as cells. */
static void widen(const uint8_t *cells, int rows, int columns, int reach, uint8_t *lines, uint8_t *result) {
    for (int i = 0; i < rows; i++) {
        const uint8_t *row = cells + (size_t)i * columns;
        uint8_t *line = lines + (size_t)i * columns;
        for (int j = 0, until = -1; j < columns; j++) {
            if (row[j]) until = j + reach;
            line[j] = j <= until;
        }
        for (int j = columns - 1, from = columns; j >= 0; j--) {
            if (row[j]) from = j - reach;
            line[j] |= j >= from;
        }
    }
    memset(result, 0, (size_t)rows * columns);
    for (int i = 0; i < rows; i++)
        for (int k = i < reach ? 0 : i - reach; k <= i + reach && k < rows; k++)
            for (int j = 0; j < columns; j++) result[(size_t)i * columns + j] |= lines[(size_t)k * columns + j];
}

/* Keeps cells between kept ones that have moved too, and what they enclose: a closing by a square. */
static void bridge_gaps(Grid grid, Scratch at) {
    const int rows = grid.rows, columns = grid.columns, wide = columns + 2;
    const size_t cells = (size_t)rows * columns;
    uint8_t *one = (uint8_t *)at.density, *lines = one + cells, *other = lines + cells, *state = at.state;
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) one[(size_t)i * columns + j] = (state[(i + 1) * wide + j + 1] & KEPT) != 0;
    widen(one, rows, columns, grid.bridge, lines, other);
    for (size_t k = 0; k < cells; k++) other[k] = !other[k];
    widen(other, rows, columns, grid.bridge, lines, one);
    int added = 0, top = 0;
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) {
            const size_t k = (size_t)i * columns + j;
            const float r = at.means[k], g = at.means[cells + k], b = at.means[2 * cells + k];
            const int place = (i + 1) * wide + j + 1;
            if (!one[k] && !(state[place] & KEPT) && r * r + g * g + b * b > grid.bridge_sigmas * grid.bridge_sigmas)
                state[place] |= ADDED, added = 1;
        }
    if (!added) return;
    for (int i = 0; i < rows + 2; i++)
        for (int j = 0; j < wide; j++) {
            const int place = i * wide + j;
            if (i == 0 || j == 0 || i == rows + 1 || j == wide - 1)
                state[place] |= REACHED;
            else if ((i == 1 || j == 1 || i == rows || j == columns) && !(state[place] & (KEPT | ADDED))) {
                state[place] |= REACHED;
                at.stack[top++] = place;
            }
        }
    spread(state, wide, KEPT | ADDED | REACHED, REACHED, at.stack, top);
    for (int i = 1; i <= rows; i++)
        for (int j = 1; j <= columns; j++) {
            uint8_t *here = state + i * wide + j;
            if (!(*here & (KEPT | REACHED))) *here = (uint8_t)((*here & ~OUTSIDE) | KEPT | FAINT);
        }
}

/* Whether no neighbour of a cell lies outside of the contact; what is beyond the image counts as contact. */
static int is_inner(Grid grid, const uint8_t *state, int i, int j) {
    for (int y = i > 0 ? i - 1 : 0; y <= i + 1 && y < grid.rows; y++)
        for (int x = j > 0 ? j - 1 : 0; x <= j + 1 && x < grid.columns; x++)
            if (state[(y + 1) * (grid.columns + 2) + x + 1] & OUTSIDE) return 0;
    return 1;
}

/* Strong pixels of kept cells, and all pixels of inner ones. */
static void to_pixels(Grid grid, Scratch at, int height, int width, uint8_t *strong, uint8_t *inner) {
    const int cell = grid.cell, wide = grid.columns + 2;
    uint8_t *kept_line = at.bytes, *inner_line = at.bytes + width;
    for (int i = 0; i < grid.rows; i++) {
        int any = 0;
        for (int j = 0; j < grid.columns; j++) {
            const uint8_t kind = at.state[(i + 1) * wide + j + 1];
            const uint8_t kept = (kind & KEPT) != 0, solid = kept && (kind & FAINT || is_inner(grid, at.state, i, j));
            const int first = j * cell;
            memset(kept_line + first, kept, (size_t)least(cell, width - first));
            memset(inner_line + first, solid, (size_t)least(cell, width - first));
            any |= kept;
        }
        for (int y = i * cell; y < least((i + 1) * cell, height); y++) {
            const size_t row = (size_t)y * width;
            if (any) {
                keep_line(kept_line, inner_line, width, strong + row);
                memcpy(inner + row, inner_line, (size_t)width);
            } else {
                memset(strong + row, 0, (size_t)width);
                memset(inner + row, 0, (size_t)width);
            }
        }
    }
}

/*
 * image (frames, 3, height, width), with offset and per_noise (3, height, width): change = image * per_noise + offset; offset
 * null where it is -per_noise. Writes mask and inner, bytes (frames, height, width); inner is where cells decide, not pixels.
 * Returns 0, 1 where memory is short, or 2 where a value is not finite or its square would not be, and the masks mean nothing.
 */
EXPORT int contact_mask(const float *image, const float *offset, const float *per_noise, const float *failed_below,
                        const float *most_far_field, int frames, int height, int width, int step, int stride, int cell, int reach,
                        float sigmas, float rounding, float least_cells, int bridge, float bridge_sigmas, uint8_t *mask,
                        uint8_t *inner) {
    const Grid grid = {(height + cell - 1) / cell, (width + cell - 1) / cell, cell, reach, least_cells, bridge, bridge_sigmas};
    const size_t pixels = (size_t)height * width, cells = (size_t)grid.rows * grid.columns;
    const size_t ringed = (size_t)(grid.rows + 2) * (grid.columns + 2);
    const size_t samples = (size_t)((height + stride - 1) / stride) * ((width + stride - 1) / stride);
    const size_t some = samples > cells ? samples : cells;
    Scratch at;
    float *floats = malloc(sizeof(float) * (2 * some + 1 + 4 * cells + 5 * (size_t)width + 2 * (size_t)reach));
    uint8_t *bytes = malloc(ringed + (size_t)(height + 3) * (width + 2));
    uint16_t *counts = malloc(sizeof(uint16_t) * (size_t)width);
    int32_t *stack = malloc(sizeof(int32_t) * ringed);
    const int short_of_memory = !floats || !bytes || !counts || !stack;
    int not_finite = 0;
    if (!short_of_memory) {
        at.some = floats, at.means = at.some + 2 * some + 1, at.density = at.means + 3 * cells, at.sums = at.density + cells;
        at.squared = at.sums + 3 * (size_t)width, at.down = at.squared + width;
        at.state = bytes, at.bytes = bytes + ringed, at.counts = counts, at.stack = stack;
    }
    for (int b = 0; b < frames && !short_of_memory; b++) {
        const float *frame = image + 3 * pixels * b;
        int works[3];
        working_leds(frame, failed_below, height, width, step, works);
        float scale[3] = {0.0f, 0.0f, 0.0f};
        for (int c = 0; c < 3; c++)
            if (works[c]) {
                const float *image_c = frame + pixels * c, *offset_c = offset ? offset + pixels * c : NULL, *per_noise_c = per_noise + pixels * c;
                float noise = noise_of(image_c, offset_c, per_noise_c, height, width, stride, at.some);
                float far = most_far_field[c] > 0.0f ? far_field_of(image_c, offset_c, per_noise_c, height, width, stride, at.some) : 0.0f;
                if (far > most_far_field[c]) far = most_far_field[c] * most_far_field[c] / far;
                if (!(far <= noise)) noise = far;
                if (noise < 1.0f) noise = 1.0f;
                scale[c] = 1.0f / sqrtf(noise * noise + rounding);
            }
        find_strong(frame, offset, per_noise, scale, height, width, sigmas * sigmas, grid, at, mask + pixels * b);
        for (size_t k = 0; k < 3 * cells; k++) /* comparisons with NaN would let pixels through here that tensors do not */
            if (!(fabsf(at.means[k]) < 1e15f)) not_finite = 2;
        if (find_cells(grid, at)) {
            keep_large(grid, at);
            if (bridge > 0) bridge_gaps(grid, at);
            to_pixels(grid, at, height, width, mask + pixels * b, inner + pixels * b);
        } else {
            memset(mask + pixels * b, 0, pixels);
            memset(inner + pixels * b, 0, pixels);
        }
    }
    free(floats), free(bytes), free(counts), free(stack);
    return short_of_memory ? 1 : not_finite;
}

/* The grids of a new frame of a track: the same results as grids of torchvts/pose/grids.py, which explains them. */
#include "kernels.h"

#define INSIDE 1
#define PERHAPS 2
#define LANES 16
#define INLINE static inline __attribute__((always_inline))

static WIDE float largest(const float *values, int64_t size) {
    float most[LANES];
    for (int k = 0; k < LANES; k++) most[k] = values[0];
    for (int64_t n = 0; n + LANES <= size; n += LANES)
        for (int k = 0; k < LANES; k++) most[k] = values[n + k] > most[k] ? values[n + k] : most[k];
    for (int64_t n = size - size % LANES; n < size; n++) most[0] = values[n] > most[0] ? values[n] : most[0];
    for (int k = 1; k < LANES; k++) most[0] = most[k] > most[0] ? most[k] : most[0];
    return most[0];
}

/* Whether each pixel lies on the object, and whether it may. */
static WIDE void flag(
    const float *depth, const uint8_t *contact, int64_t size, float least_mm, float deep, uint8_t *restrict flags) {
    for (int64_t n = 0; n < size; n++) {
        const uint8_t touching = contact[n] != 0, below = depth[n] > least_mm, far_below = depth[n] > deep;
        flags[n] = (uint8_t)((touching & below) * INSIDE | (touching | far_below) * PERHAPS);
    }
}

/* A row of flags: INSIDE where all of 3 x 3 are, PERHAPS where any of them is; nothing lies beyond the image. */
static WIDE void widen(const uint8_t *flags, int height, int width, int row, uint8_t *restrict column, uint8_t *restrict result) {
    const uint8_t *here = flags + (int64_t)row * width, *above = row > 0 ? here - width : here;
    const uint8_t *below = row < height - 1 ? here + width : here;
    for (int x = 0; x < width; x++) {
        const uint8_t all = above[x] & here[x] & below[x], any = above[x] | here[x] | below[x];
        column[x + 1] = (uint8_t)((all & INSIDE) | (any & PERHAPS));
    }
    column[0] = column[1], column[width + 1] = column[width];
    for (int x = 0; x < width; x++) {
        const uint8_t all = column[x] & column[x + 1] & column[x + 2], any = column[x] | column[x + 1] | column[x + 2];
        result[x] = (uint8_t)((all & INSIDE) | (any & PERHAPS));
    }
}

/* Each pixel of the rows from `first` to `end` as z, p, -q and a mask. */
static WIDE int whole_rows(
    const float *depth, const float *slopes, const uint8_t *flags, int height, int width, int first, int end, uint8_t *row, float *restrict field) {
    const int64_t size = (int64_t)height * width;
    int count = 0;
    for (int y = first; y < end; y++) {
        uint8_t *result = row + width + 2;
        widen(flags, height, width, y, row, result);
        const float *z = depth + (int64_t)y * width, *p = slopes + (int64_t)y * width, *q = p + size;
        float *to = field + 4 * (int64_t)y * width;
        for (int x = 0; x < width; x++) {
            const int inside = result[x] & INSIDE;
            to[4 * x] = z[x], to[4 * x + 1] = p[x], to[4 * x + 2] = -q[x];
            to[4 * x + 3] = 0.75f * (float)inside + 0.125f * (float)(result[x] & PERHAPS);
            count += inside;
        }
    }
    return count;
}

/* Sums over `times` rows from the first on, between two columns: z, p, q and the number of pixels on the object (4, width). */
static WIDE void add_rows(
    const float *depth, const float *slopes, const uint8_t *flags, int64_t size, int width, int times, int from, int to, float *restrict sums) {
    for (int k = 0; k < 4; k++) memset(sums + (int64_t)k * width + from, 0, (size_t)(to - from) * sizeof(float));
    for (int i = 0; i < times; i++) {
        const int64_t first = (int64_t)i * width;
        const float *z = depth + first, *p = slopes + first, *q = p + size;
        for (int x = from; x < to; x++) {
            const float inside = (float)(flags[first + x] & INSIDE);
            sums[x] += inside * z[x], sums[width + x] += inside * p[x], sums[2 * width + x] -= inside * q[x];
            sums[3 * width + x] += inside;
        }
    }
}

/* All flags of `times` rows (width). */
static WIDE void join_rows(const uint8_t *flags, int width, int times, uint8_t *restrict any) {
    memcpy(any, flags, (size_t)width);
    for (int i = 1; i < times; i++)
        for (int x = 0; x < width; x++) any[x] |= flags[(int64_t)i * width + x];
}

/* Means of the columns of cells from `from` to `to`, from the sums of add_rows: z, p, q and the number of pixels on the object. */
INLINE void cell_columns(const float *sums, int width, int times, int from, int to, float *restrict field) {
    const float least = 0.01f * (float)(times * times);
    const float *z = sums, *p = z + width, *q = p + width, *number = q + width;
    for (int x = from; x < to; x++) {
        float a = 0.0f, b = 0.0f, c = 0.0f, count = 0.0f;
        UNROLLED
        for (int i = 0; i < times; i++) {
            const int n = x * times + i;
            a += z[n], b += p[n], c += q[n], count += number[n];
        }
        const float per = 1.0f / (count > least ? count : least);
        field[4 * x] = a * per, field[4 * x + 1] = b * per, field[4 * x + 2] = c * per, field[4 * x + 3] = count;
    }
}

/* Flags of cells, of those of their columns. */
INLINE void cell_flags(const uint8_t *any, int times, int columns, uint8_t *restrict near) {
    for (int x = 0; x < columns; x++) {
        uint8_t flags = 0;
        UNROLLED
        for (int i = 0; i < times; i++) flags |= any[x * times + i];
        near[x] = flags & PERHAPS;
    }
}

/* Means over the part of each of a row of cells that lies on the object; the mask is the number of pixels there. */
static WIDE void cell_means(
    const float *depth, const float *slopes, const uint8_t *flags, int64_t size, int width, int times, float *sums, uint8_t *any,
    uint8_t *near, float *restrict field) {
    const int columns = width / times;
    int from = 0, to = width;
    join_rows(flags, width, times, any);
    while (from < to && !(any[from] & INSIDE)) from++;
    while (from < to && !(any[to - 1] & INSIDE)) to--;
    memset(field, 0, 4 * sizeof(float) * (size_t)columns);
    if (times == 2)
        cell_flags(any, 2, columns, near);
    else
        cell_flags(any, times, columns, near);
    if (from == to) return;
    from /= times, to = least((to + times - 1) / times, columns);
    add_rows(depth, slopes, flags, size, width, times, from * times, to * times, sums);
    if (times == 2)
        cell_columns(sums, width, 2, from, to, field);
    else
        cell_columns(sums, width, times, from, to, field);
}

/* The masks of cells, of which `share` must lie on the object. Returns how many do. */
static WIDE int mask_cells(const uint8_t *near, int rows, int columns, int times, float share, uint8_t *row, float *restrict field) {
    const float least = share * (float)(times * times);
    int count = 0;
    for (int y = 0; y < rows; y++) {
        uint8_t *result = row + columns + 2;
        widen(near, rows, columns, y, row, result);
        float *to = field + 4 * (int64_t)y * columns;
        for (int x = 0; x < columns; x++) {
            const int inside = to[4 * x + 3] > least;
            const float outside = 0.125f * (float)(result[x] & PERHAPS);
            to[4 * x + 3] = inside ? 1.0f : outside;
            count += inside;
        }
    }
    return count;
}

/* depth (height, width), slopes (2, height, width) y down, contact as bytes -> fine and coarse fields (rows, columns, 4), of cells
   of `fine` and `coarse` pixels a side. Returns the number of fine pixels on the object, or -1 without memory. */
EXPORT int track_grids(
    const float *depth, const float *slopes, const uint8_t *contact, int height, int width, float least_mm, int fine, int coarse,
    float *fine_field, float *coarse_field) {
    const int64_t size = (int64_t)height * width;
    float *sums = malloc(4 * (size_t)width * sizeof(float) + (size_t)(2 * size + 2 * (width + 2)));
    if (sums == NULL) return -1;
    uint8_t *flags = (uint8_t *)(sums + 4 * (size_t)width), *near = flags + size, *row = near + size;
    flag(depth, contact, size, least_mm, 0.3f * largest(depth, size), flags);
    const int grids[2] = {fine, coarse};
    float *fields[2] = {fine_field, coarse_field};
    int count = 0;
    for (int k = fine > 1 ? 0 : 1; k < 2; k++) {
        const int times = grids[k], rows = height / times, columns = width / times;
        for (int y = 0; y < rows; y++) {
            const int first = y * times, end = y + 1 < rows ? first + times : height;
            const int64_t at = (int64_t)first * width, to = (int64_t)y * columns;
            if (fine == 1) count += whole_rows(depth, slopes, flags, height, width, first, end, row, fine_field); /* while they are at hand */
            cell_means(depth + at, slopes + at, flags + at, size, width, times, sums, row, near + to, fields[k] + 4 * to);
        }
        const int inside = mask_cells(near, rows, columns, times, k == 0 ? 0.99f : 0.5f, row, fields[k]);
        if (k == 0) count = inside;
    }
    free(sums);
    return count;
}

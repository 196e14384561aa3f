/* Sums of a tracked pose, which a frame passes through: torchvts/pose/inverse.py and height_errors.py, which explain them. */
#include "kernels.h"

#define SIZE 7 /* six twists and the residual */

/* What the residuals depend on beside the pixels; the order is that of residual_limits in inverse.py. */
typedef struct {
    double pose[16], x0, y0, pitch, per_slope, per_height, score_slope, score_height, shallow;
} Limits;

#define INLINE static inline __attribute__((always_inline))
#define LANES 8
#define BLOCK 64 /* pixels that are summed in float32 */
#define PAIRS 28 /* of SIZE values, each once */
#define WHEN(condition, value) ((Lanes)((condition) & (Ints)(value))) /* else 0 */

typedef float Lanes __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int32_t Ints __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef double Sums __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
typedef float Four __attribute__((vector_size(16), aligned(4), may_alias)); /* the channels of a field */

/* A block of pixels in the new frame. */
typedef struct {
    float place[BLOCK], along[BLOCK], down[BLOCK], z[BLOCK], found[4][BLOCK], slope[2][BLOCK], height[BLOCK];
    float weight[BLOCK], used[BLOCK], bad[BLOCK], good[BLOCK], compared[BLOCK];
    int first[BLOCK];
} Block;

/* Where the pixels (rows x, y, z of `points`) come to lie, and what the field (height, width, 4) holds there between pixels. */
INLINE void look_up(
    const float *field, int height, int width, const float *points, int64_t stride, int size, const Limits *at, Block *b) {
    float P[12];
    for (int k = 0; k < 12; k++) P[k] = (float)at->pose[k];
    const float x0 = (float)at->x0, y0 = (float)at->y0, per_mm = (float)(1.0 / at->pitch);
    const float last_column = (float)(width - 1), last_row = (float)(height - 1);
    for (int n = 0; n < size; n++) {
        const float x = points[n], y = points[stride + n], z = points[2 * stride + n];
        const float column = (P[0] * x + P[1] * y + P[2] * z + P[3] - x0) * per_mm;
        const float row = (y0 - (P[4] * x + P[5] * y + P[6] * z + P[7])) * per_mm;
        const int within = (column >= 0.0f) & (column <= last_column) & (row >= 0.0f) & (row <= last_row);
        const float safe_row = within ? row : 0.0f, safe_column = within ? column : 0.0f;
        const int top = least((int)safe_row, height - 2), left = least((int)safe_column, width - 2);
        b->z[n] = P[8] * x + P[9] * y + P[10] * z + P[11];
        b->place[n] = within ? 1.0f : 0.0f;
        b->first[n] = 4 * (top * width + left);
        b->down[n] = safe_row - (float)top, b->along[n] = safe_column - (float)left;
    }
    float found[BLOCK][4];
    for (int n = 0; n < size; n++) {
        const float *upper = field + b->first[n], *lower = upper + 4 * (size_t)width;
        const Four a = *(const Four *)upper, c = *(const Four *)lower;
        const Four u = a + b->along[n] * (*(const Four *)(upper + 4) - a), l = c + b->along[n] * (*(const Four *)(lower + 4) - c);
        *(Four *)found[n] = u + b->down[n] * (l - u);
    }
    for (int n = 0; n < size; n++)
        for (int k = 0; k < 4; k++) b->found[k][n] = found[n][k];
}

/* Residuals, Cauchy's weights and the score of a block; slopes of the pixels in the rows 3 and 4 of `points`. */
INLINE void compare(const float *points, int64_t stride, int size, const Limits *at, Block *b) {
    float P[12];
    for (int k = 0; k < 12; k++) P[k] = (float)at->pose[k];
    const float per_slope = (float)at->per_slope, per_height = (float)at->per_height; /* 1 / noise^2 */
    const float score_slope = (float)at->score_slope, score_height = (float)at->score_height;
    const float shallow = (float)at->shallow;
    const int whole = (size + LANES - 1) / LANES * LANES;
    const Lanes one = {1.0f, 1.0f, 1.0f, 1.0f, 1.0f, 1.0f, 1.0f, 1.0f};
    float expected[2][BLOCK];
    for (int k = 0; k < 2; k++) memcpy(expected[k], points + (3 + k) * stride, (size_t)size * sizeof(float));
    for (int n = size; n < whole; n++) { /* lanes beyond the last pixel hold zeros */
        b->place[n] = b->z[n] = expected[0][n] = expected[1][n] = 0.0f;
        for (int k = 0; k < 4; k++) b->found[k][n] = 0.0f;
    }
    for (int n = 0; n < whole; n += LANES) {
        const Lanes height = *(const Lanes *)(b->found[0] + n), p = *(const Lanes *)(b->found[1] + n);
        const Lanes q = *(const Lanes *)(b->found[2] + n), mask = *(const Lanes *)(b->found[3] + n), z = *(const Lanes *)(b->z + n);
        const Lanes up = P[10] - P[2] * p - P[6] * q;
        const Lanes steep = 1.0f / (WHEN(up > 0.05f, up) + WHEN(up <= 0.05f, 0.05f * one));
        const Lanes off_p = (P[0] * p + P[4] * q - P[8]) * steep - *(const Lanes *)(expected[0] + n);
        const Lanes off_q = (P[1] * p + P[5] * q - P[9]) * steep - *(const Lanes *)(expected[1] + n);
        const Lanes off_z = height - z, off = off_p * off_p + off_q * off_q, high = off_z * off_z;
        const Lanes error = off * score_slope + high * score_height;
        const Ints within = (*(const Lanes *)(b->place + n) > 0.5f) & (z > shallow), inside = within & (mask > 0.999f);
        const Ints counted = within & ((mask > 0.999f) | (mask <= 0.001f)), good = inside & (error < 1.0f);
        *(Lanes *)(b->bad + n) = WHEN(counted & good, error) + WHEN(counted & ~good, one);
        *(Lanes *)(b->good + n) = WHEN(counted & good, one), *(Lanes *)(b->compared + n) = WHEN(counted, one);
        *(Lanes *)(b->used + n) = WHEN(inside, one);
        *(Lanes *)(b->weight + n) = WHEN(inside, 1.0f / (1.0f + 0.25f * (off * per_slope + high * per_height)));
        *(Lanes *)(b->slope[0] + n) = off_p, *(Lanes *)(b->slope[1] + n) = off_q, *(Lanes *)(b->height + n) = off_z;
    }
}

INLINE double sum_of(const Sums *lanes) {
    double sum = 0.0;
    for (int k = 0; k < LANES; k++) sum += (*lanes)[k];
    return sum;
}

/* Adds the weighted products of the rows of p, q and z of the Jacobian (18, ...), and of the residuals. */
INLINE void add_products(const float *jacobian, int64_t stride, int size, const Limits *at, const Block *b, Sums *products) {
    const float scales[3] = {(float)at->per_slope, (float)at->per_slope, (float)at->per_height};
    const float *residuals[3] = {b->slope[0], b->slope[1], b->height};
    UNROLLED
    for (int k = 0; k < SIZE; k++) { /* at most seven sums at a time, which fit into registers */
        Lanes total[SIZE];
        memset(total, 0, sizeof(total));
        for (int n = 0; n < size; n += LANES) {
            UNROLLED
            for (int r = 0; r < 3; r++) {
                const float *lines[SIZE] = {[SIZE - 1] = residuals[r]};
                UNROLLED
                for (int m = 0; m < SIZE - 1; m++) lines[m] = jacobian + (6 * r + m) * stride;
                const Lanes scaled = *(const Lanes *)(b->weight + n) * scales[r] * *(const Lanes *)(lines[k] + n);
                UNROLLED
                for (int m = k; m < SIZE; m++) total[m] += scaled * *(const Lanes *)(lines[m] + n);
            }
        }
        UNROLLED
        for (int m = k; m < SIZE; m++) *products++ += __builtin_convertvector(total[m], Sums);
    }
}

/* Sums over `count` pixels: columns (23, stride) x, y, z, p, q and the 18 of the Jacobian, which score_only does not read.
   sums: SIZE * SIZE products, then seven of the score. */
EXPORT WIDE void alignment_sums(
    const float *field, int height, int width, const float *columns, int64_t stride, int count, int score_only, const Limits *at,
    double *sums) {
    Block b;
    float tail[18 * BLOCK];
    Sums products[PAIRS], score[7];
    memset(products, 0, sizeof(products)), memset(score, 0, sizeof(score));
    for (int start = 0; start < count; start += BLOCK) {
        const int size = least(BLOCK, count - start);
        const float *points = columns + start, *jacobian = points + 5 * stride;
        look_up(field, height, width, points, stride, size, at, &b);
        compare(points, stride, size, at, &b);
        Lanes parts[7];
        memset(parts, 0, sizeof(parts));
        for (int n = 0; n < size; n += LANES) {
            const Lanes weight = *(const Lanes *)(b.weight + n), p = *(const Lanes *)(b.slope[0] + n);
            const Lanes q = *(const Lanes *)(b.slope[1] + n), z = *(const Lanes *)(b.height + n);
            parts[0] += *(const Lanes *)(b.used + n), parts[1] += weight;
            parts[2] += weight * (p * p + q * q), parts[3] += weight * z * z;
            parts[4] += *(const Lanes *)(b.bad + n), parts[5] += *(const Lanes *)(b.good + n);
            parts[6] += *(const Lanes *)(b.compared + n);
        }
        for (int k = 0; k < 7; k++) score[k] += __builtin_convertvector(parts[k], Sums);
        if (score_only) continue;
        int64_t step = stride;
        if (size % LANES) { /* lanes beyond the last pixel hold zeros */
            memset(tail, 0, sizeof(tail));
            for (int k = 0; k < 18; k++) memcpy(tail + BLOCK * k, jacobian + k * stride, (size_t)size * sizeof(float));
            jacobian = tail, step = BLOCK;
        }
        add_products(jacobian, step, size, at, &b, products);
    }
    for (int k = 0, pair = 0; k < SIZE; k++)
        for (int m = k; m < SIZE; m++, pair++) sums[SIZE * k + m] = sums[SIZE * m + k] = sum_of(products + pair);
    for (int k = 0; k < 7; k++) sums[SIZE * SIZE + k] = sum_of(score + k);
}

/* Sums of the heights of the frame minus those of the pixels, by cells, and how many they are. */
static WIDE void cell_residuals(
    const float *field, int height, int width, const float *columns, int64_t stride, int count, const Limits *at, const int64_t *cell,
    float most_mm, double *sum, double *seen) {
    Block b;
    const float shallow = (float)at->shallow;
    for (int start = 0; start < count; start += BLOCK) {
        const int size = least(BLOCK, count - start);
        look_up(field, height, width, columns + start, stride, size, at, &b);
        for (int n = 0; n < size; n++) {
            const float off = b.found[0][n] - b.z[n];
            const int held = (b.place[n] > 0.5f) & (b.z[n] > shallow) & (b.found[3][n] > 0.999f) & (fabsf(off) < most_mm);
            if (held) sum[cell[start + n]] += (double)off, seen[cell[start + n]] += 1.0;
        }
    }
}

/* Adds the products of four lines (4, size), times `sign`, to the upper triangle of A (size, size). */
static WIDE void add_lines(const double *lines, int size, double sign, double *restrict A) {
    const double *a = lines, *b = a + size, *c = b + size, *d = c + size;
    for (int i = 0; i < size; i++)
        for (int k = i; k < size; k++) A[i * size + k] += sign * (a[i] * a[k] + b[i] * b[k] + c[i] * c[k] + d[i] * d[k]);
}

/* Adds a line times a residual. */
static WIDE void add_residual(const double *line, int size, double residual, double *restrict sums) {
    for (int k = 0; k < size; k++) sums[k] += residual * line[k];
}

/* Eliminates the first `gone` unknowns of the symmetric A (size, size), by its upper triangle. */
static WIDE void eliminate(double *A, int size, int gone) {
    for (int m = 0; m < gone; m++) {
        const double *line = A + m * size, per = 1.0 / line[m];
        for (int i = m + 1; i < size; i++) {
            double *restrict to = A + i * size;
            const double factor = line[i] * per;
            for (int k = i; k < size; k++) to[k] -= factor * line[k];
        }
    }
}

/* height_sums of torchvts/pose/height_errors.py: lines (cells, modes + 6) and the products of all of them; number (cells) of pixels;
   left (7, 7), products of the six twists and the residual where the modes are fitted beside. Returns 1 without memory. */
EXPORT int height_sums(
    const float *field, int height, int width, const float *columns, int64_t stride, int count, const Limits *at, const int64_t *cell,
    const double *number, const double *lines, const double *products, int cells, int modes, double most_mm, double white_mm, double *left) {
    const int twists = modes + 6, size = modes + SIZE;
    double *A = calloc((size_t)(size * size + 5 * size + 2 * cells), sizeof(double));
    if (A == NULL) return 1;
    double *some = A + size * size, *right = some + 4 * size, *sum = right + size, *seen = sum + cells;
    cell_residuals(field, height, width, columns, stride, count, at, cell, (float)most_mm, sum, seen);
    int used = 0, taken = 0;
    for (int n = 0; n < cells; n++) used += seen[n] >= 0.5 * number[n];
    const int most = 2 * used > cells; /* those that are not used are taken away from all */
    for (int i = 0; i < twists && most; i++) memcpy(A + i * size, products + i * twists, (size_t)twists * sizeof(double));
    for (int n = 0; n < cells; n++) {
        const double *line = lines + (int64_t)n * twists;
        const int uses = seen[n] >= 0.5 * number[n];
        if (uses) {
            const double residual = sum[n] / (seen[n] * white_mm);
            add_residual(line, twists, residual, right);
            right[twists] += residual * residual;
        }
        if (uses == most) continue;
        memcpy(some + taken++ % 4 * size, line, (size_t)twists * sizeof(double));
        if (taken % 4 == 0) add_lines(some, size, most ? -1.0 : 1.0, A);
    }
    memset(some + taken % 4 * size, 0, (size_t)((4 - taken % 4) * size) * sizeof(double));
    if (taken % 4 != 0) add_lines(some, size, most ? -1.0 : 1.0, A);
    for (int k = 0; k < size; k++) A[k * size + twists] = right[k];
    for (int k = 0; k < modes; k++) A[k * size + k] += 1.0;
    eliminate(A, size, modes);
    for (int k = 0; k < SIZE; k++)
        for (int m = k; m < SIZE; m++) left[SIZE * k + m] = left[SIZE * m + k] = A[(modes + k) * size + modes + m];
    free(A);
    return 0;
}

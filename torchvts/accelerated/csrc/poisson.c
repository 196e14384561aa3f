/* What lies between the Fourier transforms of the cosine-family Poisson solver: the same numbers as torchvts/integration/poisson.py and
   transforms.py, which say why. Complex numbers are pairs of floats. */
#include "kernels.h"

/* Half the difference of what lies after and before each element, and below and above it: a line of the divergence. */
WIDE static void difference(const float *restrict padded, const float *restrict above, const float *restrict below, float half, int n,
                            float *restrict line) {
    for (int x = 0; x < n; x++) line[x] = half * (padded[x + 2] - padded[x] + below[x] - above[x]);
}

/* Even places first, then the odd ones backwards. */
WIDE static void reorder(const float *restrict line, int n, float *restrict result) {
    for (int x = 0; x < (n + 1) / 2; x++) result[x] = line[2 * x];
    for (int x = 0; x < n / 2; x++) result[n - 1 - x] = line[2 * x + 1];
}

/* The inverse of reorder(), less `level`. */
WIDE static void restore(const float *restrict line, int n, float level, float *restrict result) {
    for (int x = 0; x < n / 2; x++) {
        result[2 * x] = line[x] - level;
        result[2 * x + 1] = line[n - 1 - x] - level;
    }
    if (n % 2) result[n - 1] = line[n / 2] - level;
}

/* Row y of the window, times `sign`; nothing where there is no such row. */
static void place(const float *rows_of, int y, int rows, int columns, float sign, float *line) {
    if (y < 0 || y >= rows) return;
    const float *source = rows_of + (size_t)y * columns;
    for (int x = 0; x < columns; x++) line[x] = sign * source[x];
}

/*
 * gradient (frames, 2, rows, columns): that of a window at (top, left) of an image of height x width, zero elsewhere. Writes the lines
 * of the divergence from row `first` on, reordered along x, (frames, count, width). Beyond the border a gradient is that of the border
 * with the other sign, so that edges out of the image count as zero. Returns 0, or 1 where memory is short.
 */
EXPORT int divergence_lines(const float *gradient, float mm_per_pixel, int frames, int rows, int columns, int top, int left, int height,
                            int width, int first, int count, float *lines) {
    float *padded = malloc(sizeof(float) * (4 * (size_t)width + 2));
    if (!padded) return 1;
    float *above = padded + width + 2, *below = above + width, *line = below + width;
    for (int b = 0; b < frames; b++) {
        const float *p = gradient + 2 * (size_t)b * rows * columns, *q = p + (size_t)rows * columns;
        for (int k = 0; k < count; k++) {
            const int y = first + k - top;
            memset(padded, 0, sizeof(float) * (3 * (size_t)width + 2));
            if (y >= 0 && y < rows) {
                memcpy(padded + 1 + left, p + (size_t)y * columns, sizeof(float) * (size_t)columns);
                padded[0] = -padded[1];
                padded[width + 1] = -padded[width];
            }
            const int lowest = first + k == height - 1, highest = first + k == 0;
            place(q, lowest ? y : y + 1, rows, columns, lowest ? -1.0f : 1.0f, below + left);
            place(q, highest ? y : y - 1, rows, columns, highest ? -1.0f : 1.0f, above + left);
            difference(padded, above, below, 0.5f * mm_per_pixel, width, line);
            reorder(line, width, lines + ((size_t)b * count + k) * width);
        }
    }
    free(padded);
    return 0;
}

/* Transposes lines (frames, count, n) of pairs into columns (frames, n, height) of pairs, line k to place order[k]; zero elsewhere. */
EXPORT void to_columns(const uint64_t *lines, const int64_t *order, int frames, int count, int n, int height, uint64_t *columns) {
    memset(columns, 0, sizeof(uint64_t) * (size_t)frames * n * height);
    for (int b = 0; b < frames; b++)
        for (int first = 0; first < n; first += 8)
            for (int k = 0; k < count; k++) {
                const uint64_t *line = lines + ((size_t)b * count + k) * n;
                uint64_t *column = columns + (size_t)b * n * height + order[k];
                for (int x = first; x < least(first + 8, n); x++) column[(size_t)x * height] = line[x];
            }
}

/* One column's rows k and n - k, which meet only each other; `back` holds the latter and gets them. */
WIDE static void scale(float *restrict here, float *restrict back, const float *restrict turn, const float *restrict other,
                       const float *restrict of_sum, const float *restrict of_difference, int n) {
    for (int k = 0; k < n; k++) {
        const float a = turn[2 * k], b = turn[2 * k + 1], c = other[2 * k], d = other[2 * k + 1];
        const float u = 0.5f * (a * here[2 * k] - b * here[2 * k + 1]), v = 0.5f * (a * here[2 * k + 1] + b * here[2 * k]);
        const float r = 0.5f * (c * back[2 * k] - d * back[2 * k + 1]), s = 0.5f * (c * back[2 * k + 1] + d * back[2 * k]);
        const float sum = (u + r) * of_sum[2 * k], sum_i = (v + s) * of_sum[2 * k + 1];
        const float residual = (u - r) * of_difference[2 * k], residual_i = (v - s) * of_difference[2 * k + 1];
        here[2 * k] = a * (sum + residual) + b * (sum_i + residual_i);
        here[2 * k + 1] = a * (sum_i + residual_i) - b * (sum + residual);
        back[2 * k] = c * (sum - residual) + d * (sum_i - residual_i);
        back[2 * k + 1] = c * (sum_i - residual_i) - d * (sum - residual);
    }
}

/*
 * In place: spectrum (frames, n, height) of pairs divided by the Laplacian's eigenvalues. turns (2, n, height / 2 + 1) of pairs, of_sum and
 * of_difference (n, height / 2 + 1, 2): see cosine_tables(). Returns 0, or 1 where memory is short.
 */
EXPORT int divide(float *spectrum, const float *turns, const float *of_sum, const float *of_difference, int frames, int n, int height) {
    const int half = height / 2 + 1;
    uint64_t *back = malloc(sizeof(uint64_t) * (size_t)half);
    if (!back) return 1;
    for (int b = 0; b < frames; b++)
        for (int x = 0; x < n; x++) {
            uint64_t *column = (uint64_t *)spectrum + ((size_t)b * n + x) * height;
            const size_t at = 2 * (size_t)x * half;
            back[0] = column[0];
            for (int k = 1; k < half; k++) back[k] = column[height - k];
            scale((float *)column, (float *)back, turns + at, turns + 2 * (size_t)n * half + at, of_sum + at, of_difference + at, half);
            for (int k = 1; k < (height + 1) / 2; k++) column[height - k] = back[k];
        }
    free(back);
    return 0;
}

/* Sum of the depth where the gradient is, and how many pixels that are; lines as in finish_depth(). */
static double deformed_sum(const float *lines, const float *gradient, const int64_t *order, int rows, int columns, int top, int left,
                          int width, size_t *deformed) {
    const float *p = gradient, *q = gradient + (size_t)rows * columns;
    double sum = 0.0;
    for (int y = 0; y < rows; y++) {
        const float *line = lines + (size_t)order[top + y] * width;
        for (int x = 0; x < columns; x++, p++, q++)
            if (*p != 0.0f || *q != 0.0f) {
                const int at = left + x;
                sum += line[at % 2 ? width - 1 - at / 2 : at / 2];
                ++*deformed;
            }
    }
    return sum;
}

/*
 * Depth (frames, height, width) from lines of that size whose rows and columns are reordered. Given the gradient of the window
 * (frames, 2, rows, columns) at (top, left), the depth is zero on average where the gradient is zero, and where that is nowhere, zero
 * at its lowest.
 */
EXPORT void finish_depth(const float *lines, const int64_t *order, const float *gradient, int frames, int rows, int columns, int top, int left,
                   int height, int width, float *depth) {
    const size_t pixels = (size_t)height * width;
    for (int b = 0; b < frames; b++, lines += pixels, depth += pixels) {
        double level = 0.0;
        if (gradient) {
            size_t deformed = 0;
            const double sum = deformed_sum(lines, gradient + 2 * (size_t)b * rows * columns, order, rows, columns, top, left, width, &deformed);
            if (deformed < pixels)
                level = -sum / (double)(pixels - deformed);
            else {
                level = lines[0];
                for (size_t k = 1; k < pixels; k++)
                    if (lines[k] < level) level = lines[k];
            }
        }
        for (int y = 0; y < height; y++) restore(lines + (size_t)order[y] * width, width, (float)level, depth + (size_t)y * width);
    }
}

/* Largest magnitude of n differences. Compared as whole numbers, whose order is that of floats without sign, and which are vectorised. */
WIDE static uint32_t largest(const float *restrict one, const float *restrict other, size_t n) {
    uint32_t most = 0;
    for (size_t k = 0; k < n; k++) {
        union {
            float value;
            uint32_t bits;
        } residual = {one[k] - other[k]};
        residual.bits &= 0x7fffffffu;
        most = residual.bits > most ? residual.bits : most;
    }
    return most;
}

/* Largest difference of each of `frames` pairs of depths of n pixels. */
EXPORT void largest_change(const float *one, const float *other, int frames, int64_t n, float *change) {
    for (int b = 0; b < frames; b++) {
        const uint32_t bits = largest(one + b * n, other + b * n, (size_t)n);
        memcpy(change + b, &bits, sizeof bits);
    }
}

/* Depth from slopes with a free border: the same results as PoissonDCT of torchvts/integration/poisson.py, by other means. A cosine transform of the columns
   makes of the five-point Laplacian one equation along x for each coefficient k,
       u[x + 1] - (2 + 4 sin^2(pi k / 2H)) u[x] + u[x - 1] = f[x],
   which two recursions with one pole r solve, from left to right and back: 1 / r + r = 2 + 4 sin^2(pi k / 2H). All of the image's columns are
   even about its borders. (Unser, Splines, IEEE Signal Processing Magazine 16(6), 1999, solves spline filters so.) */
#include "cosine.h"
#include "plan.h"

#if defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif

static const double PI = 3.14159265358979323846;

/* Coefficients from 0 on that depth gets wave by wave: they are nearly all of it, and a transform rounds them at each of its steps. */
enum { WAVES = 4 };

/* Tables of one size: the poles, what both recursions multiply by, 1 / (1 - r^2W), the start of the way back; the first WAVES waves, WAVES values
   for each row; then those of the transform. */
typedef struct {
    int height, width, wide;
    const double *pole, *gain, *per_start, *end;
    const float *waves;
    Cosine cosine;
} Solver;

/* Coefficients lie in slices of so many, SLICE of the first column, of the second and so on. */
enum { SLICE = 64 };

/* Coefficients of a column, in whole slices. */
static int wide_of(int height) { return (height + SLICE - 1) / SLICE * SLICE; }

/* Where coefficient k of column x lies, of slices of `columns` columns. */
static inline size_t place_of(size_t k, size_t x, size_t columns) { return (k / SLICE * columns + x) * SLICE + k % SLICE; }

/* Bytes of the tables; 0 where the height has a prime factor that is too large. */
size_t poisson_size(int height) {
    int radix[MOST_PASSES];
    if (height < 2 || !cosine_radices(height, radix)) return 0;
    return sizeof(double) * 4 * (size_t)wide_of(height) + sizeof(float) * (WAVES * (size_t)height + cosine_table_size(height));
}

void make_poisson(int height, int width, double *tables) {
    const int wide = wide_of(height);
    memset(tables, 0, sizeof(double) * 4 * (size_t)wide); /* the constant, k = 0, is solved by itself */
    for (int k = 1; k < height; k++) {
        const double sine = sin(PI * k / (2.0 * height)), half = 2.0 * sine * sine;
        const double rest = sqrt(2.0 * half + half * half) - half, pole = 1.0 - rest; /* 1 - r, without cancellation */
        tables[k] = pole;
        tables[wide + k] = -pole / height;
        tables[2 * wide + k] = -1.0 / expm1(2.0 * width * log1p(-rest));
        tables[3 * wide + k] = -pole / height / rest;
    }
    float *waves = (float *)(tables + 4 * wide);
    for (int y = 0; y < height; y++)
        for (int k = 0; k < WAVES; k++) *waves++ = k < height ? (float)((k ? 2.0 : 1.0) * cos(PI * k * (2 * y + 1) / (2.0 * height))) : 0.0f;
    make_cosine_tables(height, waves);
}

static Solver solver_of(int height, int width, const double *tables) {
    const int wide = wide_of(height);
    const float *waves = (const float *)(tables + 4 * wide);
    const Solver of = {height, width, wide, tables, tables + wide, tables + 2 * wide, tables + 3 * wide, waves,
                       cosine_of(height, waves + WAVES * (size_t)height)};
    return of;
}

/* A row of the divergence of a gradient: half the difference of what lies after and before each element, and below and above it. Beyond the border
   of the image a gradient is that of the border with the other sign, so that edges out of the image count as zero. */
WIDE static void difference(const float *restrict p, const float *restrict above, float sign_above, const float *restrict below, float sign_below,
                            float half, int n, float *restrict line) {
    for (int x = 1; x < n - 1; x++) line[x] = half * (p[x + 1] - p[x - 1] + sign_below * below[x] - sign_above * above[x]);
    line[0] = half * (p[1] + p[0] + sign_below * below[0] - sign_above * above[0]);
    line[n - 1] = half * (-p[n - 1] - p[n - 2] + sign_below * below[n - 1] - sign_above * above[n - 1]);
}

/* The divergence of a gradient (2, height, width), in lines of `step` floats, zeros beyond the width. */
static void divergence(const float *gradient, int height, int width, float half_pitch, float *lines, int step) {
    const float *q = gradient + (size_t)height * width;
    for (int y = 0; y < height; y++, gradient += width, q += width, lines += step) {
        const int first = y == 0, last = y == height - 1;
        difference(gradient, first ? q : q - width, first ? -1.0f : 1.0f, last ? q : q + width, last ? -1.0f : 1.0f, half_pitch, width, lines);
        memset(lines + width, 0, sizeof(float) * (size_t)(step - width));
    }
}

/* Added and taken away, it makes zero of what is far below 1e-30: the recursions run into such numbers, and processors are a hundred times slower
   with those that a float cannot hold in full. */
static const double LARGE = 1e-15;

/* One step of a recursion, for each of n coefficients. */
WIDE FUSED static void sum_up(const float *restrict values, const double *restrict pole, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) sum[k] = (values[k] + pole[k] * sum[k] + LARGE) - LARGE;
}

WIDE FUSED static void back(const float *restrict values, const double *restrict pole, const double *restrict gain, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) sum[k] = (gain[k] * values[k] + pole[k] * sum[k] + LARGE) - LARGE;
}

/* Doubles to floats, n a multiple of 4. */
WIDE static void narrow(const double *restrict sum, int n, float *restrict values) {
#if defined(__wasm_simd128__) /* for which LLVM rounds one by one */
    for (int k = 0; k < n; k += 4) {
        const v128_t low = wasm_f32x4_demote_f64x2_zero(wasm_v128_load(sum + k)), high = wasm_f32x4_demote_f64x2_zero(wasm_v128_load(sum + k + 2));
        wasm_v128_store(values + k, wasm_i64x2_shuffle(low, high, 0, 2));
    }
#else
    for (int k = 0; k < n; k++) values[k] = (float)sum[k];
#endif
}

/* sum *= pole^exponent. power: n doubles. */
WIDE static void times_power(const double *restrict pole, int exponent, int n, double *restrict power, double *restrict sum) {
    memcpy(power, pole, sizeof(double) * (size_t)n);
    for (; exponent; exponent >>= 1) {
        if (exponent & 1)
            for (int k = 0; k < n; k++) sum[k] *= power[k];
        for (int k = 0; k < n; k++) power[k] *= power[k];
    }
}

/* What lies left of the image, which the image mirrored gives, and the sum up to it. */
WIDE static void begin(const double *restrict one, const double *restrict per_start, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) sum[k] = (sum[k] + one[k]) * per_start[k];
}

WIDE static void turn_round(const float *restrict values, const double *restrict end, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) sum[k] = end[k] * values[k];
}

/* Along x: a slice of coefficients becomes that of the depth. */
static void recursions(const Solver *of, int from, float *slice) {
    const int width = of->width, n = SLICE;
    const double *pole = of->pole + from;
    double sum[SLICE] = {0.0}, other[SLICE] = {0.0}, power[SLICE];
    for (int x = width - 1; x >= 0; x--) sum_up(slice + (size_t)x * SLICE, pole, n, sum);
    for (int x = 0; x < width; x++) sum_up(slice + (size_t)x * SLICE, pole, n, other);
    times_power(pole, width, n, power, other);
    begin(other, of->per_start + from, n, sum);
    for (int x = 0; x < width; x++) sum_up(slice + (size_t)x * SLICE, pole, n, sum), narrow(sum, n, slice + (size_t)x * SLICE);
    turn_round(slice + (size_t)(width - 1) * SLICE, of->end + from, n, sum);
    for (int x = width - 1; x >= 0; x--) back(slice + (size_t)x * SLICE, pole, of->gain + from, n, sum), narrow(sum, n, slice + (size_t)x * SLICE);
}

/* The same for the constant along y, k = 0: sums of sums, less the mean. constant: its values, and gets the result. */
static void solve_constant(const Solver *of, double *constant) {
    const int width = of->width;
    double mean = 0.0, slope = 0.0, depth = 0.0, total = 0.0;
    for (int x = 0; x < width; x++) mean += constant[x] / width;
    for (int x = 0; x < width; x++) {
        const double here = constant[x];
        constant[x] = depth, total += depth / width;
        slope += here - mean, depth += slope;
    }
    for (int x = 0; x < width; x++) constant[x] = (constant[x] - total) / of->height;
}

/* LINES columns of the divergence, whose lines have `step` floats, from `first` on, to their coefficients. */
static void to_coefficients(const Solver *of, const float *lines, int step, int first, float *scratch, float *found, float *coefficients) {
    const size_t n = (size_t)of->height, wide = (size_t)of->wide, columns = (size_t)of->width + LINES;
    for (int y = 0; y < of->height; y++) {
        const float *line = lines + (size_t)y * step + first;
        float *to = cosine_line(&of->cosine, scratch, y);
        memcpy(to, line, sizeof(float) * LANES);
        memcpy(to + n * LANES, line + LANES, sizeof(float) * LANES);
    }
    cosine_forward(&of->cosine, scratch, found);
    for (size_t k = 0; k < wide; k += 4)
        for (int x = 0; x < LINES; x += 4)
            transpose(found + k * LINES + x, LINES, coefficients + place_of(k, (size_t)(first + x), columns), SLICE);
}

/* LANES values of a row, with the first waves of their columns. low: WAVES coefficients of LANES columns, LINES floats for each. */
WIDE FUSED static void add_waves(const float *restrict low, const float *restrict wave, float *restrict row) {
    for (int t = 0; t < LANES; t++) {
        float sum = row[t];
        for (int k = WAVES - 1; k >= 0; k--) sum += wave[k] * low[k * LINES + t];
        row[t] = sum;
    }
}

/* The inverse, of LINES columns of depth from `first` on, to `lines`. scratch: as much memory; found: coefficients. */
static void to_depth(const Solver *of, const float *coefficients, int first, float *scratch, float *found, float *lines) {
    const size_t wide = (size_t)of->wide, columns = (size_t)of->width + LINES;
    for (size_t k = 0; k < wide; k += 4)
        for (int x = 0; x < LINES; x += 4) transpose(coefficients + place_of(k, (size_t)(first + x), columns), SLICE, found + k * LINES + x, LINES);
    float low[WAVES * LINES];
    memcpy(low, found, sizeof low);
    memset(found, 0, sizeof low);
    cosine_inverse(&of->cosine, found, scratch, lines);
    for (int y = 0; y < of->height; y++) {
        float *row = cosine_line(&of->cosine, lines, y);
        add_waves(low, of->waves + WAVES * (size_t)y, row);
        add_waves(low + LANES, of->waves + WAVES * (size_t)y, row + (size_t)of->height * LANES);
    }
}

/* n pixels of a row of depth: LANES of them together, and `step` floats on the next ones. */
static void row_of_depth(const float *lanes, size_t step, int n, float *row) {
    for (int x = 0; x < n; x += LANES, lanes += step) memcpy(row + x, lanes, sizeof(float) * (size_t)least(LANES, n - x));
}

/* Memory of solve_one(): a double for each column; coefficients, and lines, those of the divergence, and then of depth, LINES columns after the other as
   transforms leave them (written to rows at once, each line of memory would be fetched for a part of a block); and of a transform: lines twice, and
   the coefficients of LINES columns. */
typedef struct {
    double *constant;
    float *coefficients, *lines, *scratch, *found;
} Memory;

static void solve_one(const Solver *of, const float *gradient, float half_pitch, Memory at, float *depth) {
    const int height = of->height, width = of->width, blocks = (width + LINES - 1) / LINES;
    const size_t columns = (size_t)width + LINES, step = (size_t)height * LANES;
    divergence(gradient, height, width, half_pitch, at.lines, blocks * LINES);
    for (int k = 0; k < blocks; k++) to_coefficients(of, at.lines, blocks * LINES, k * LINES, at.scratch, at.found, at.coefficients);
    for (int x = 0; x < width; x++) at.constant[x] = at.coefficients[(size_t)x * SLICE];
    for (int k = 0; k < of->wide; k += SLICE) recursions(of, k, at.coefficients + place_of((size_t)k, 0, columns));
    solve_constant(of, at.constant);
    for (int x = 0; x < width; x++) at.coefficients[(size_t)x * SLICE] = (float)at.constant[x];
    for (int k = 0; k < blocks; k++) to_depth(of, at.coefficients, k * LINES, at.scratch, at.found, at.lines + (size_t)k * LINES * height);
    for (int y = 0; y < height; y++) row_of_depth(cosine_line(&of->cosine, at.lines, y), step, width, depth + (size_t)y * width);
}

int integrate(const Plan *plan, Scratch *shared, const float *gradient, float *depth) {
    const int height = (int)plan->height, width = (int)plan->width;
    const Solver of = solver_of(height, width, plan->poisson);
    const size_t wide = (size_t)of.wide, columns = (size_t)width + LINES;
    const size_t coefficients = columns * wide, lines = columns * (size_t)height, scratch = cosine_scratch_size(height);
    const size_t taken = shared->used, bytes = sizeof(double) * (size_t)width + sizeof(float) * (coefficients + lines + scratch + wide * LINES);
    double *memory = lend(shared, bytes);
    if (!memory) return NO_MEMORY;
    memset(memory, 0, bytes);
    float *floats = (float *)(memory + width);
    const Memory at = {memory, floats, floats + coefficients, floats + coefficients + lines, floats + coefficients + lines + scratch};
    solve_one(&of, gradient, 0.5f * (float)plan->mm_per_pixel, at, depth);
    give_back(shared, taken);
    return DONE;
}

/* Depth from slopes with a free border: the same results as torchvts/integration/poisson.py, by other means. A cosine transform of the columns
   makes of the five-point Laplacian one equation along x for each coefficient k,
       u[x + 1] - (2 + 4 sin^2(pi k / 2H)) u[x] + u[x - 1] = f[x],
   which two recursions with one pole r solve, from left to right and back: 1 / r + r = 2 + 4 sin^2(pi k / 2H). All of the image's columns are
   even about its borders. (Unser, Splines, IEEE Signal Processing Magazine 16(6), 1999, solves spline filters so.) */
#include "cosine.h"

#include <math.h>

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
} Plan;

/* Coefficients lie in slices of so many, SLICE of the first column, of the second and so on, so that threads which solve for some of them read
   one piece of memory. */
enum { SLICE = 64 };

/* Coefficients of a column, in whole slices. */
static int wide_of(int height) { return (height + SLICE - 1) / SLICE * SLICE; }

/* Where coefficient k of column x lies, of slices of `columns` columns. */
static inline size_t place_of(size_t k, size_t x, size_t columns) { return (k / SLICE * columns + x) * SLICE + k % SLICE; }

/* Bytes of the tables; 0 where the height has a prime factor that is too large. */
EXPORT int64_t poisson_plan_size(int height) {
    int radix[MOST_PASSES];
    if (height < 2 || !cosine_radices(height, radix)) return 0;
    return (int64_t)(sizeof(double) * 4 * (size_t)wide_of(height) + sizeof(float) * (WAVES * (size_t)height + cosine_table_size(height)));
}

EXPORT void make_poisson_plan(int height, int width, double *tables) {
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

static Plan plan_of(int height, int width, const double *tables) {
    const int wide = wide_of(height);
    const float *waves = (const float *)(tables + 4 * wide);
    const Plan plan = {height, width, wide, tables, tables + wide, tables + 2 * wide, tables + 3 * wide, waves,
                       cosine_of(height, waves + WAVES * (size_t)height)};
    return plan;
}

/* Half the difference of what lies after and before each element, and below and above it: a line of the divergence. */
WIDE static void difference(const float *restrict padded, const float *restrict above, const float *restrict below, float half, int n,
                            float *restrict line) {
    for (int x = 0; x < n; x++) line[x] = half * (padded[x + 2] - padded[x] + below[x] - above[x]);
}

/* Row y of the window, times `sign`; nothing where there is no such row. */
static void place(const float *rows_of, int y, int rows, int columns, float sign, float *line) {
    if (y < 0 || y >= rows) return;
    const float *source = rows_of + (size_t)y * columns;
    for (int x = 0; x < columns; x++) line[x] = sign * source[x];
}

/* A part of an image: its first row and column, how many, and those of the pixels beside it too. */
typedef struct {
    int top, left, rows, columns, first_row, last_row, first_column, last_column;
} Part;

static Part part_of(int rows, int columns, int top, int left, int height, int width) {
    const Part part = {top, left, rows, columns, top > 0 ? top - 1 : 0, least(top + rows + 1, height), left > 0 ? left - 1 : 0,
                       least(left + columns + 1, width)};
    return part;
}

/* Rows `first` to `last` of the divergence of a gradient, (2, rows, columns), where it is not zero: lines of `step` floats. Beyond the border of the
   image a gradient is that of the border with the other sign, so that edges out of the image count as zero. scratch: three lines, and two floats. */
static void divergence(const float *gradient, const Part *part, int first, int last, int height, int width, float half_pitch, float *scratch,
                       float *lines, int step) {
    const int n = part->last_column - part->first_column, before = part->left - part->first_column, columns = part->columns;
    float *padded = scratch, *above = scratch + n + 2, *below = above + n;
    const float *p = gradient, *q = gradient + (size_t)part->rows * columns;
    for (int line = first; line < last; line++) {
        const int y = line - part->top;
        float *to = lines + (size_t)(line - part->first_row) * step;
        memset(scratch, 0, sizeof(float) * (3 * (size_t)n + 2));
        if (y >= 0 && y < part->rows) {
            memcpy(padded + 1 + before, p + (size_t)y * columns, sizeof(float) * (size_t)columns);
            if (part->first_column == 0) padded[0] = -padded[1];
            if (part->last_column == width) padded[n + 1] = -padded[n];
        }
        const int lowest = line == height - 1, highest = line == 0;
        place(q, lowest ? y : y + 1, part->rows, columns, lowest ? -1.0f : 1.0f, below + before);
        place(q, highest ? y : y - 1, part->rows, columns, highest ? -1.0f : 1.0f, above + before);
        difference(padded, above, below, half_pitch, n, to);
        memset(to + n, 0, sizeof(float) * (size_t)(step - n));
    }
}

/* Very small numbers become zero: the recursions run into them, and processors are a hundred times slower there. */
static unsigned int without_tiny(void) {
#if defined(__SSE__)
    const unsigned int before = _mm_getcsr();
    _mm_setcsr(before | 0x8040u);
    return before;
#else
    return 0;
#endif
}

static void with_tiny(unsigned int before) {
#if defined(__SSE__)
    _mm_setcsr(before);
#else
    (void)before;
#endif
}

/* One step of a recursion, for each of n coefficients. */
WIDE FUSED static void sum_up(const float *restrict values, const double *restrict pole, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) sum[k] = values[k] + pole[k] * sum[k];
}

/* The same, whose sums take the values' place. */
WIDE FUSED static void there(float *restrict values, const double *restrict pole, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) {
        sum[k] = values[k] + pole[k] * sum[k];
        values[k] = (float)sum[k];
    }
}

/* The same of values that are zero. */
WIDE FUSED static void there_alone(float *restrict values, const double *restrict pole, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) {
        sum[k] *= pole[k];
        values[k] = (float)sum[k];
    }
}

WIDE FUSED static void back(float *restrict values, const double *restrict pole, const double *restrict gain, int n, double *restrict sum) {
    for (int k = 0; k < n; k++) {
        sum[k] = gain[k] * values[k] + pole[k] * sum[k];
        values[k] = (float)sum[k];
    }
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

/* Along x: a slice of coefficients, zero but in the part's columns, becomes that of the depth. state: three lines of doubles. */
static void recursions(const Plan *plan, const Part *part, int from, float *slice, double *state) {
    const int width = plan->width, first = part->first_column, last = part->last_column, n = SLICE;
    const double *pole = plan->pole + from;
    double *sum = state, *other = sum + SLICE, *power = other + SLICE;
    memset(sum, 0, 2 * SLICE * sizeof(double));
    for (int x = last - 1; x >= first; x--) sum_up(slice + (size_t)x * SLICE, pole, n, sum);
    for (int x = first; x < last; x++) sum_up(slice + (size_t)x * SLICE, pole, n, other);
    times_power(pole, first, n, power, sum);
    times_power(pole, 2 * width - last, n, power, other);
    begin(other, plan->per_start + from, n, sum);
    for (int x = 0; x < first; x++) there_alone(slice + (size_t)x * SLICE, pole, n, sum);
    for (int x = first; x < last; x++) there(slice + (size_t)x * SLICE, pole, n, sum);
    for (int x = last; x < width; x++) there_alone(slice + (size_t)x * SLICE, pole, n, sum);
    turn_round(slice + (size_t)(width - 1) * SLICE, plan->end + from, n, sum);
    for (int x = width - 1; x >= 0; x--) back(slice + (size_t)x * SLICE, pole, plan->gain + from, n, sum);
}

/* The same for the constant along y, k = 0: sums of sums, less the mean. constant: its values, and gets the result. */
static void solve_constant(const Plan *plan, double *constant) {
    const int width = plan->width;
    double mean = 0.0, slope = 0.0, depth = 0.0, total = 0.0;
    for (int x = 0; x < width; x++) mean += constant[x] / width;
    for (int x = 0; x < width; x++) {
        const double here = constant[x];
        constant[x] = depth, total += depth / width;
        slope += here - mean, depth += slope;
    }
    for (int x = 0; x < width; x++) constant[x] = (constant[x] - total) / plan->height;
}

/* LINES columns of the divergence, whose lines have `step` floats, from `first` on, to their coefficients. */
static void to_coefficients(const Plan *plan, const Part *part, const float *lines, int step, int first, float *scratch, float *found,
                            float *coefficients) {
    const size_t n = (size_t)plan->height, wide = (size_t)plan->wide, columns = (size_t)plan->width + LINES, to_column = (size_t)(part->first_column + first);
    memset(scratch, 0, sizeof(float) * n * LINES);
    for (int y = part->first_row; y < part->last_row; y++) {
        const float *line = lines + (size_t)(y - part->first_row) * step + first;
        float *to = cosine_line(&plan->cosine, scratch, y);
        memcpy(to, line, sizeof(float) * LANES);
        memcpy(to + n * LANES, line + LANES, sizeof(float) * LANES);
    }
    cosine_forward(&plan->cosine, scratch, found);
    for (size_t k = 0; k < wide; k += 4)
        for (int x = 0; x < LINES; x += 4)
            transpose(found + k * LINES + x, LINES, coefficients + place_of(k, to_column + x, columns), SLICE);
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
static void to_depth(const Plan *plan, const float *coefficients, int first, float *scratch, float *found, float *lines) {
    const size_t wide = (size_t)plan->wide, columns = (size_t)plan->width + LINES;
    for (size_t k = 0; k < wide; k += 4)
        for (int x = 0; x < LINES; x += 4) transpose(coefficients + place_of(k, (size_t)(first + x), columns), SLICE, found + k * LINES + x, LINES);
    float low[WAVES * LINES];
    memcpy(low, found, sizeof low);
    memset(found, 0, sizeof low);
    cosine_inverse(&plan->cosine, found, scratch, lines);
    for (int y = 0; y < plan->height; y++) {
        float *row = cosine_line(&plan->cosine, lines, y);
        add_waves(low, plan->waves + WAVES * (size_t)y, row);
        add_waves(low + LANES, plan->waves + WAVES * (size_t)y, row + (size_t)plan->height * LANES);
    }
}

/* n pixels of a row of depth less its level: LANES of them together, and `step` floats on the next ones. */
WIDE static void row_of_depth(const float *lanes, size_t step, float level, int n, float *restrict row) {
    int x = 0;
    for (; x + LANES <= n; x += LANES, lanes += step)
        for (int t = 0; t < LANES; t++) row[x + t] = lanes[t] - level;
    for (int t = 0; x < n; x++, t++) row[x] = lanes[t] - level;
}

/* Sum of depth where the slopes are not zero, and how many pixels that are. */
WIDE static double inclined_sum(const float *restrict depth, const float *restrict p, const float *restrict q, int n, int32_t *count) {
    double sums[LANES] = {0.0}, total = 0.0;
    int some = 0, x = 0;
    for (; x + LANES <= n; x += LANES) {
        float kept[LANES];
        for (int t = 0; t < LANES; t++) {
            const int is = (p[x + t] != 0.0f) | (q[x + t] != 0.0f);
            kept[t] = (float)is * depth[x + t]; /* no branch, which the compiler would not vectorise */
            some += is;
        }
        for (int t = 0; t < LANES; t++) sums[t] += kept[t];
    }
    for (int t = 0; x < n; x++, t++) {
        const int is = (p[x] != 0.0f) | (q[x] != 0.0f);
        sums[t] += is ? depth[x] : 0.0f;
        some += is;
    }
    for (int t = 0; t < LANES; t++) total += sums[t];
    *count += some;
    return total;
}

/* The solution of one frame. Each part of the work has LINES columns, or a slice of coefficients of all, or a band of rows, and scratch of its
   own: transforms and their coefficients, and the lines of the divergence's borders. `lines` are those of the divergence, and then of depth, LINES
   columns after the other as transforms leave them: written to rows at once, each line of memory would be fetched for a part of a block. */
typedef struct {
    Plan plan;
    Part part;
    const float *gradient;
    float half_pitch, level;
    int step;
    float *lines, *coefficients, *depth;
    double *row_sum; /* of depth where the gradient is not zero, of each row of the part, and how many pixels those are */
    int32_t *row_count;
    atomic_int short_of_memory;
} Solution;

/* Memory of one transform: lines twice, then the coefficients, of which those beyond the height are zero. Null where memory is short. */
static float *transform_memory(Solution *of) {
    const size_t scratch = cosine_scratch_size(of->plan.height), height = (size_t)of->plan.height, wide = (size_t)of->plan.wide;
    float *memory = malloc(sizeof(float) * (scratch + wide * LINES));
    if (memory)
        memset(memory + scratch + height * LINES, 0, sizeof(float) * (wide - height) * LINES);
    else
        of->short_of_memory = 1;
    return memory;
}

static void diverge(void *with, int band) {
    Solution *of = with;
    const int rows = of->part.last_row - of->part.first_row, bands = bands_of(rows), first = of->part.first_row;
    float *scratch = malloc(sizeof(float) * (3 * (size_t)of->plan.width + 2));
    if (scratch)
        divergence(of->gradient, &of->part, first + rows * band / bands, first + rows * (band + 1) / bands, of->plan.height, of->plan.width,
                   of->half_pitch, scratch, of->lines, of->step);
    else
        of->short_of_memory = 1;
    free(scratch);
}

static void transform(void *with, int block) {
    Solution *of = with;
    float *memory = transform_memory(of);
    const unsigned int before = without_tiny();
    if (memory)
        to_coefficients(&of->plan, &of->part, of->lines, of->step, block * LINES, memory, memory + cosine_scratch_size(of->plan.height),
                        of->coefficients);
    with_tiny(before);
    free(memory);
}

static void recur(void *with, int slice) {
    Solution *of = with;
    double state[3 * SLICE];
    const unsigned int before = without_tiny();
    recursions(&of->plan, &of->part, slice * SLICE, of->coefficients + place_of((size_t)slice * SLICE, 0, (size_t)of->plan.width + LINES), state);
    with_tiny(before);
}

static void transform_back(void *with, int block) {
    Solution *of = with;
    float *memory = transform_memory(of);
    const unsigned int before = without_tiny();
    if (memory)
        to_depth(&of->plan, of->coefficients, block * LINES, memory, memory + cosine_scratch_size(of->plan.height),
                 of->lines + (size_t)block * of->plan.height * LINES);
    with_tiny(before);
    free(memory);
}

/* Row y of depth, less `level`, from `first`, a multiple of LANES, to `last`. */
static void depth_in_row(const Solution *of, int y, int first, int last, float level, float *row) {
    const size_t step = (size_t)of->plan.height * LANES;
    row_of_depth(cosine_line(&of->plan.cosine, of->lines, y) + (size_t)(first / LANES) * step, step, level, last - first, row);
}

static void sum_rows(void *with, int band) {
    Solution *of = with;
    const Part *part = &of->part;
    const int bands = bands_of(part->rows), first = part->left / LANES * LANES;
    for (int y = part->rows * band / bands; y < part->rows * (band + 1) / bands; y++) {
        const float *p = of->gradient + (size_t)y * part->columns;
        float *row = of->depth + (size_t)(part->top + y) * of->plan.width;
        depth_in_row(of, part->top + y, first, part->left + part->columns, 0.0f, row + first);
        of->row_count[y] = 0;
        of->row_sum[y] = inclined_sum(row + part->left, p, p + (size_t)part->rows * part->columns, part->columns, of->row_count + y);
    }
}

/* The depth at which the gradient is zero on average, or where that is nowhere, the lowest. Depth has zero mean. */
static float level_of(Solution *of) {
    const size_t pixels = (size_t)of->plan.height * of->plan.width;
    double sum = 0.0;
    size_t inclined = 0;
    share(sum_rows, of, bands_of(of->part.rows));
    for (int y = 0; y < of->part.rows; y++) sum += of->row_sum[y], inclined += (size_t)of->row_count[y];
    if (inclined < pixels) return (float)(-sum / (double)(pixels - inclined));
    float level = of->depth[0]; /* the part is the whole image */
    for (size_t k = 1; k < pixels; k++)
        if (of->depth[k] < level) level = of->depth[k];
    return level;
}

static void write_rows(void *with, int band) {
    Solution *of = with;
    const int height = of->plan.height, width = of->plan.width, bands = bands_of(height);
    for (int y = height * band / bands; y < height * (band + 1) / bands; y++)
        depth_in_row(of, y, 0, width, of->level, of->depth + (size_t)y * width);
}

/* constant: a double for each column. */
static void solve_one(Solution *of, int zeroed, double *constant) {
    const Part *part = &of->part;
    const int width = of->plan.width, height = of->plan.height;
    share(diverge, of, bands_of(part->last_row - part->first_row));
    share(transform, of, of->step / LINES);
    for (int x = 0; x < width; x++) constant[x] = x >= part->first_column && x < part->last_column ? of->coefficients[(size_t)x * SLICE] : 0.0;
    share(recur, of, of->plan.wide / SLICE);
    solve_constant(&of->plan, constant);
    for (int x = 0; x < width; x++) of->coefficients[(size_t)x * SLICE] = (float)constant[x];
    share(transform_back, of, (width + LINES - 1) / LINES);
    if (of->short_of_memory) return;
    of->level = zeroed ? level_of(of) : 0.0f;
    share(write_rows, of, bands_of(height));
}

/*
 * Depth (frames, height, width) of gradients (frames, 2, rows, columns) of a window at (top, left), zero elsewhere; tables: of
 * make_poisson_plan(). It has zero mean; `zeroed`, it is zero on average where the gradient is zero. Returns 1 where memory is short.
 */
EXPORT int solve_poisson(const float *gradient, const double *tables, float mm_per_pixel, int frames, int rows, int columns, int top, int left,
                         int height, int width, int zeroed, float *depth) {
    Solution work = {.plan = plan_of(height, width, tables), .part = part_of(rows, columns, top, left, height, width), .half_pitch = 0.5f * mm_per_pixel};
    const size_t wide = (size_t)work.plan.wide, lines = (size_t)height * (width + LINES), blocks = (size_t)width + LINES; /* the same for every window */
    double *constant = malloc(sizeof(double) * ((size_t)width + height) + sizeof(float) * (blocks * wide + lines + (size_t)height));
    if (!constant) return 1;
    work.step = (work.part.last_column - work.part.first_column + LINES - 1) / LINES * LINES;
    work.row_sum = constant + width, work.coefficients = (float *)(work.row_sum + height), work.lines = work.coefficients + blocks * wide;
    work.row_count = (int32_t *)(work.lines + lines);
    for (size_t k = 0; k < wide; k += SLICE) /* columns beyond the image, which fill its last block */
        memset(work.coefficients + place_of(k, (size_t)width, blocks), 0, sizeof(float) * SLICE * LINES);
    for (int b = 0; b < frames && !work.short_of_memory; b++) {
        work.gradient = gradient + 2 * (size_t)rows * columns * b, work.depth = depth + (size_t)height * width * b;
        solve_one(&work, zeroed, constant);
    }
    free(constant);
    return work.short_of_memory;
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

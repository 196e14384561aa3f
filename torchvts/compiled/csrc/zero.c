/* Depth counted from the undeformed skin: ZeroBackground of torchvts/skin/zero.py, which explains it. In double precision. */
#include "plan.h"

/* Grids of cells and sums of one frame. */
typedef struct {
    int rows, columns, n, pairs_y, pairs_x, unknowns;
    double *depth, *weight, *pressure, *sums, *unchanged, *pit, *stiff; /* of n cells; sums: what enters one */
    double *line, *lines, *by_pressure, *others, *system, *right, *found; /* line: of `width` values */
} Work;

static WIDE void add_to(const float *restrict values, int n, double *restrict line) {
    for (int x = 0; x < n; x++) line[x] += (double)values[x];
}

static WIDE void raise_to(const float *restrict values, int n, float *restrict line) {
    for (int x = 0; x < n; x++) line[x] = values[x] > line[x] ? values[x] : line[x];
}

/* Means of depth over whole cells. line: `width` values. */
static void mean_depth(const Plan *plan, const float *depth, double *line, const Work *at) {
    const int width = (int)plan->width, cell = (int)plan->zero_cell;
    for (int i = 0; i < at->rows; i++) {
        memset(line, 0, sizeof(double) * (size_t)width);
        for (int y = i * cell; y < (i + 1) * cell; y++) add_to(depth + (size_t)y * width, width, line);
        for (int j = 0; j < at->columns; j++) {
            double sum = 0.0;
            for (int k = 0; k < cell; k++) sum += line[j * cell + k];
            at->depth[i * at->columns + j] = sum / (double)(cell * cell);
        }
    }
}

/* The largest weight in a cell and beside it; the last cells may be parts. line: `width` values. */
static void widest_weight(const Plan *plan, const float *weight, float *line, const Work *at) {
    const int width = (int)plan->width, height = (int)plan->height, cell = (int)plan->zero_cell;
    const int across = (width + cell - 1) / cell, down = (height + cell - 1) / cell;
    memset(at->weight, 0, sizeof(double) * (size_t)at->n);
    for (int i = 0; i < down; i++) {
        memset(line, 0, sizeof(float) * (size_t)width);
        for (int y = i * cell; y < least((i + 1) * cell, height); y++) raise_to(weight + (size_t)y * width, width, line);
        for (int j = 0; j < across; j++) {
            float most = 0.0f;
            for (int x = j * cell; x < least((j + 1) * cell, width); x++) most = line[x] > most ? line[x] : most;
            for (int v = i > 0 ? i - 1 : 0; v <= least(i + 1, at->rows - 1); v++)
                for (int u = j > 0 ? j - 1 : 0; u <= least(j + 1, at->columns - 1); u++)
                    at->weight[v * at->columns + u] = fmax(at->weight[v * at->columns + u], (double)most);
        }
    }
}

/* p = z - L^2 laplace z with a free border. */
static void find_pressure(const Work *at, double decay) {
    for (int i = 0; i < at->rows; i++)
        for (int j = 0; j < at->columns; j++) {
            const double *z = at->depth + i * at->columns + j;
            const double left = j ? z[-1] : *z, right = j < at->columns - 1 ? z[1] : *z;
            const double above = i ? z[-at->columns] : *z, below = i < at->rows - 1 ? z[at->columns] : *z;
            at->pressure[i * at->columns + j] = *z - decay * (right + left + below + above - 4.0 * *z);
        }
}

/* How the offset starts, negative: the lower quartile of free depth, which may be a face of the object, or the lower eighth of all, if that is
   lower; the lowest where nothing is free. some: 2 n floats. */
static double start_of(const Work *at, float *some, int *any_free) {
    int count = 0;
    for (int k = 0; k < at->n; k++)
        if (at->weight[k] < 0.1) some[count++] = (float)at->depth[k];
    *any_free = count > 0;
    const float free = count ? sorted(some, some + count, count)[count / 4] : INFINITY;
    for (int k = 0; k < at->n; k++) some[k] = (float)at->depth[k];
    return -(double)fminf(free, sorted(some, some + at->n, at->n)[count ? at->n / 8 : 0]);
}

/* result (lines, width) += factors (lines, n) times values (n, width), four values at a time, which spares memory. */
static WIDE FUSED void multiply_add(const double *factors, int lines, int n, const double *values, int width, double *result) {
    for (int p = 0; p < lines; p++, factors += n, result += width) {
        double *restrict to = result;
        int k = 0;
        for (; k + 4 <= n; k += 4) {
            const double *restrict a = values + (size_t)k * width, *restrict b = a + width, *restrict c = b + width, *restrict d = c + width;
            const double f = factors[k], g = factors[k + 1], h = factors[k + 2], i = factors[k + 3];
            for (int x = 0; x < width; x++) to[x] += (f * a[x] + g * b[x]) + (h * c[x] + i * d[x]);
        }
        for (; k < n; k++) {
            const double *restrict a = values + (size_t)k * width, f = factors[k];
            for (int x = 0; x < width; x++) to[x] += f * a[x];
        }
    }
}

/* Sums over cells of fields (rows, columns) times each pair of terms: by_pressure of `unchanged`, others of `sums` and of `stiff` with slopes. */
static void sum_products(const Plan *plan, const Work *at) {
    const size_t size = (size_t)at->pairs_y * at->columns;
    const int p = at->pairs_y, q = at->pairs_x, h = at->rows, w = at->columns;
    memset(at->lines, 0, sizeof(double) * size);
    multiply_add(plan->pairs_y, p, h, at->unchanged, w, at->lines), multiply_add(at->lines, p, w, plan->pairs_x, q, at->by_pressure);
    memset(at->lines, 0, sizeof(double) * size);
    multiply_add(plan->pairs_y, p, h, at->sums, w, at->lines), multiply_add(plan->slope_pairs_y, p, h, at->stiff, w, at->lines);
    multiply_add(at->lines, p, w, plan->pairs_x, q, at->others);
    memset(at->lines, 0, sizeof(double) * size);
    multiply_add(plan->pairs_y, p, h, at->stiff, w, at->lines), multiply_add(at->lines, p, w, plan->slope_pairs_x, q, at->others);
}

/* The place of the pair (i, k), i <= k, of n terms. */
static inline int pair_of(int i, int k, int n) {
    const int low = i < k ? i : k, high = i < k ? k : i;
    return low * n - low * (low - 1) / 2 + high - low;
}

/* The upper half of the system, from sums over pairs. */
static void fill_system(const Plan *plan, const Work *at) {
    const int ky = (int)plan->waves_y, kx = (int)plan->waves_x;
    for (int i = 0, row = 0; i < ky; i++)
        for (int j = 0; j < kx; j++, row++)
            for (int k = i, column = i * kx; k < ky; k++) {
                const size_t line = (size_t)pair_of(i, k, ky) * at->pairs_x;
                for (int m = 0; m < kx; m++, column++) {
                    const size_t place = line + pair_of(j, m, kx);
                    at->system[(size_t)row * at->unknowns + column] =
                        at->by_pressure[place] * plan->by_pressure[row] * plan->by_pressure[column] + at->others[place];
                }
            }
}

/* The rows of `some` pivots from k on, by those above them among the same. */
static WIDE FUSED void factor(double *A, int n, int k, int some) {
    for (int i = k; i < k + some; i++) {
        double *restrict row = A + (size_t)i * n;
        for (int m = k; m < i; m++) {
            const double *restrict above = A + (size_t)m * n, factor = above[i];
            for (int x = i; x < n; x++) row[x] -= factor * above[x];
        }
        const double per = 1.0 / sqrt(row[i] > 1e-300 ? row[i] : 1e-300);
        for (int x = i; x < n; x++) row[x] *= per;
    }
}

/* Solves A x = b of n unknowns by Cholesky's factors, by the upper half of A, which it overwrites; x takes the place of b. */
static WIDE FUSED void solve(double *A, double *b, int n) {
    int k = 0;
    for (; k + 4 <= n; k += 4) {
        factor(A, n, k, 4);
        const double *restrict p = A + (size_t)k * n, *restrict q = p + n, *restrict r = q + n, *restrict s = r + n;
        for (int i = k + 4; i < n; i++) {
            double *restrict row = A + (size_t)i * n;
            const double f = p[i], g = q[i], h = r[i], e = s[i];
            for (int x = i; x < n; x++) row[x] -= (f * p[x] + g * q[x]) + (h * r[x] + e * s[x]);
        }
    }
    factor(A, n, k, n - k);
    for (int i = 0; i < n; i++) {
        const double *restrict row = A + (size_t)i * n;
        b[i] /= row[i];
        for (int x = i + 1; x < n; x++) b[x] -= row[x] * b[i];
    }
    for (int i = n - 1; i >= 0; i--) {
        double sum = b[i];
        for (int x = i + 1; x < n; x++) sum -= A[(size_t)i * n + x] * b[x];
        b[i] = sum / A[(size_t)i * n + i];
    }
}

/* Sums of a field times each term (waves_y, waves_x), to `sums`. */
static WIDE FUSED void project(const Plan *plan, const Work *at, const double *field, double *line, double *sums) {
    const int ky = (int)plan->waves_y, kx = (int)plan->waves_x;
    for (int i = 0; i < ky; i++) {
        for (int x = 0; x < at->columns; x++) line[x] = 0.0;
        for (int y = 0; y < at->rows; y++)
            for (int x = 0; x < at->columns; x++) line[x] += plan->cosine_y[i * at->rows + y] * field[y * at->columns + x];
        for (int j = 0; j < kx; j++) {
            double sum = 0.0;
            for (int x = 0; x < at->columns; x++) sum += line[x] * plan->cosine_x[j * at->columns + x];
            sums[i * kx + j] = sum;
        }
    }
}

/* The fit, from an offset that is the same everywhere. */
static void fit_offset(const Plan *plan, const Work *at, double reach) {
    const size_t pairs = (size_t)at->pairs_y * at->pairs_x;
    for (int k = 0; k < at->n; k++) {
        const double z = at->depth[k] + at->found[0], off = z / (plan->face * reach), fall = 1.0 + off * off;
        const double below = fmin(fmax(-z / (plan->pit_share * reach) - 1.0, 0.0), 1.0), deep = fmin(fmax(z / reach, 0.0), 1.0);
        at->unchanged[k] = (1.0 - at->weight[k]) / (fall * fall);
        at->pit[k] = plan->pit * at->weight[k] * below;
        at->stiff[k] = plan->smooth_mm * plan->smooth_mm * (1.0 + plan->stiff * deep * deep);
    }
    memset(at->by_pressure, 0, sizeof(double) * 2 * pairs);
    for (int k = 0; k < at->n; k++) at->sums[k] = at->pit[k] + 1e-6;
    sum_products(plan, at);
    fill_system(plan, at);
    for (int k = 0; k < at->n; k++) at->unchanged[k] *= at->pressure[k], at->sums[k] = at->pit[k] * at->depth[k];
    project(plan, at, at->unchanged, at->line, at->right);
    project(plan, at, at->sums, at->line, at->found);
    for (int k = 0; k < at->unknowns; k++) at->right[k] = -(at->right[k] * plan->by_pressure[k] + at->found[k]);
    solve(at->system, at->right, at->unknowns);
    memcpy(at->found, at->right, sizeof(double) * (size_t)at->unknowns);
}

/* Adds the offset to depth. */
static WIDE FUSED void add_offset(const Plan *plan, const double *found, float *line, float *sums, float *depth) {
    const int height = (int)plan->height, width = (int)plan->width, ky = (int)plan->waves_y, kx = (int)plan->waves_x;
    for (int y = 0; y < height; y++, depth += width) {
        for (int j = 0; j < kx; j++) {
            double sum = 0.0;
            for (int i = 0; i < ky; i++) sum += (double)plan->pixel_y[(size_t)i * height + y] * found[i * kx + j];
            line[j] = (float)sum;
        }
        for (int x = 0; x < width; x++) sums[x] = line[0]; /* the first wave is 1 everywhere */
        int j = 1;
        for (; j + 4 <= kx; j += 4) {
            const float *restrict a = plan->pixel_x + (size_t)j * width, *restrict b = a + width, *restrict c = b + width, *restrict d = c + width;
            const float f = line[j], g = line[j + 1], h = line[j + 2], i = line[j + 3];
            for (int x = 0; x < width; x++) sums[x] += (f * a[x] + g * b[x]) + (h * c[x] + i * d[x]);
        }
        for (; j < kx; j++) {
            const float *restrict a = plan->pixel_x + (size_t)j * width, f = line[j];
            for (int x = 0; x < width; x++) sums[x] += f * a[x];
        }
        for (int x = 0; x < width; x++) depth[x] += sums[x];
    }
}

int zero_background(const Plan *plan, Scratch *scratch, const float *weight, float *depth) {
    const int cell = (int)plan->zero_cell, rows = (int)plan->height / cell, columns = (int)plan->width / cell;
    const int ky = (int)plan->waves_y, kx = (int)plan->waves_x, n = rows * columns, unknowns = ky * kx;
    const size_t pairs = (size_t)(ky * (ky + 1) / 2) * (kx * (kx + 1) / 2);
    /* seven grids of n cells; `some` of start_of, of the room of one; then the rest of Work */
    const size_t size = 8 * (size_t)n + (size_t)plan->width + (size_t)(ky * (ky + 1) / 2) * columns + 2 * pairs + (size_t)unknowns * (unknowns + 2) + (size_t)plan->width + (size_t)kx;
    const size_t before = scratch->used;
    double *memory = lend(scratch, sizeof(double) * size);
    if (!memory) return NO_MEMORY;
    Work at = {rows, columns, n, ky * (ky + 1) / 2, kx * (kx + 1) / 2, unknowns, memory, memory + n, memory + 2 * n, memory + 3 * n,
               memory + 4 * n, memory + 5 * n, memory + 6 * n, memory + 8 * n, NULL, NULL, NULL, NULL, NULL, NULL};
    at.lines = at.line + plan->width, at.by_pressure = at.lines + (size_t)at.pairs_y * columns, at.others = at.by_pressure + pairs, at.system = at.others + pairs;
    at.right = at.system + (size_t)unknowns * unknowns, at.found = at.right + unknowns;
    int any_free;
    mean_depth(plan, depth, at.line, &at), widest_weight(plan, weight, (float *)at.line, &at);
    find_pressure(&at, plan->zero_decay);
    double low = at.depth[0], high = at.depth[0];
    for (int k = 0; k < n; k++) low = at.depth[k] < low ? at.depth[k] : low, high = at.depth[k] > high ? at.depth[k] : high;
    const double reach = fmax(high - low, 1e-9);
    for (int k = 0; k < unknowns; k++) at.found[k] = 0.0;
    at.found[0] = start_of(&at, (float *)(memory + 7 * n), &any_free);
    if (any_free) fit_offset(plan, &at, reach);
    float *line = (float *)(at.found + unknowns);
    add_offset(plan, at.found, line, line + kx, depth);
    give_back(scratch, before);
    return DONE;
}

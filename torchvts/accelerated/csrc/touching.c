/* Contact from depth: the same results as torchvts/contact/touching.py, which explains them. */
#include "kernels.h"

#include <math.h>

/* The settings of ContactFromDepth. */
typedef struct {
    float cell_mm, share, least_decay, most_decay, least_tail, most_tail, least_free, most_unexplained, noise_depth_mm;
} Model;

/* Fields of rows x columns cells; `found` and `other` hold what is at hand. */
typedef struct {
    int rows, columns;
    float *mass, *depth, *slope_x, *slope_y, *curvature, *smooth_mass, *smooth_depth, *pressure, *found, *other, *unexplained, *squared;
    float *sums, *line;
    double *running;
    uint8_t *pressed, *surface;
} Cells;

/* A row of pixels added to a line of cells: how many are deformed, and their depth and slopes. */
WIDE static void add_pixels(const uint8_t *restrict inside, const float *restrict depth, const float *restrict p, const float *restrict q,
                            int cell, int n, float *restrict mass, float *restrict z, float *restrict x, float *restrict y) {
    for (int k = 0; k < cell; k++)
        for (int j = 0; j < n; j++) {
            const int at = j * cell + k;
            const float in = (float)inside[at];
            mass[j] += in, z[j] += depth[at] * in, x[j] += p[at] * in, y[j] += q[at] * in;
        }
}

WIDE static void scale(float *restrict values, float by, int n) {
    for (int k = 0; k < n; k++) values[k] *= by;
}

WIDE static void add_row(const float *restrict values, double *restrict running, int n, float *restrict sums) {
    for (int x = 0; x < n; x++) {
        running[x] += (double)values[x];
        sums[x] = (float)running[x];
    }
}

WIDE static void subtract(const float *restrict a, const float *restrict b, int n, float *restrict result) {
    for (int x = 0; x < n; x++) result[x] = a[x] - b[x];
}

enum { ROWS = 4 };

/* Running sums along ROWS rows, `step` floats apart, to `sums`, of each cell those of all rows together. Each sum waits for the one before it, so several
   rows are summed at once. */
static void run_along(const float *rows, int step, int columns, float *restrict sums) {
    double total[ROWS] = {0.0};
    memset(sums, 0, ROWS * sizeof(float));
    for (int x = 0; x < columns; x++)
        for (int k = 0; k < ROWS; k++) {
            total[k] += (double)rows[k * step + x];
            sums[ROWS * (x + 1) + k] = (float)total[k];
        }
}

/* Means over `reach` cells either way of row k of those, zero beyond the border. */
WIDE static void means_along(const float *restrict sums, int columns, int reach, float area, float *restrict to) {
    const int inner = columns - reach;
    int x = 0;
    for (; x < reach && x < columns; x++) to[x] = sums[ROWS * least(x + reach + 1, columns)] / area;
    for (; x < inner; x++) to[x] = (sums[ROWS * (x + reach + 1)] - sums[ROWS * (x - reach)]) / area;
    for (; x < columns; x++) to[x] = (sums[ROWS * columns] - sums[ROWS * (x - reach)]) / area;
}

/* Mean over `reach` cells either way, by running sums as torch rounds them; zero beyond the border. */
static void box(const Cells *at, const float *values, int reach, float *result) {
    const int rows = at->rows, columns = at->columns, side = 2 * reach + 1;
    const float area = (float)(side * side);
    memset(at->running, 0, sizeof(double) * (size_t)columns);
    memset(at->sums, 0, sizeof(float) * (size_t)columns);
    for (int y = 0; y < rows; y++) add_row(values + (size_t)y * columns, at->running, columns, at->sums + (size_t)(y + 1) * columns);
    for (int y = 0; y < rows; y++) {
        const int before = y > reach ? y - reach : 0, last = least(y + reach + 1, rows);
        subtract(at->sums + (size_t)last * columns, at->sums + (size_t)before * columns, columns, result + (size_t)y * columns);
    }
    const int many = rows < ROWS ? 1 : ROWS;
    for (int y = 0; y < rows; y += many) { /* the last rows are summed again where their number is no multiple, and some not used */
        const int first = least(y, rows - many);
        run_along(result + (size_t)first * columns, many > 1 ? columns : 0, columns, at->line);
        for (int k = y - first; k < many; k++) means_along(at->line + k, columns, reach, area, result + (size_t)(first + k) * columns);
    }
}

/* Divergence of slopes, times the mass; beyond cells without deformed skin, and beyond the border, slopes go on as they are. */
static void find_curvature(const Cells *at, float two_cells_mm) {
    const int rows = at->rows, columns = at->columns;
    for (int y = 0; y < rows; y++)
        for (int x = 0; x < columns; x++) {
            const size_t k = (size_t)y * columns + x;
            const float here_x = at->slope_x[k], here_y = at->slope_y[k];
            const float right = x < columns - 1 && at->mass[k + 1] > 0.0f ? at->slope_x[k + 1] : here_x;
            const float left = x > 0 && at->mass[k - 1] > 0.0f ? at->slope_x[k - 1] : here_x;
            const float below = y < rows - 1 && at->mass[k + columns] > 0.0f ? at->slope_y[k + columns] : here_y;
            const float above = y > 0 && at->mass[k - columns] > 0.0f ? at->slope_y[k - columns] : here_y;
            at->other[k] = (right - left + below - above) / two_cells_mm * at->mass[k];
        }
}

WIDE static void divide(float *restrict values, const float *restrict by, float least_by, int n) {
    for (int k = 0; k < n; k++) values[k] /= by[k] > least_by ? by[k] : least_by;
}

static float largest(const float *values, int n) {
    float most = values[0];
    for (int k = 1; k < n; k++) most = values[k] > most ? values[k] : most;
    return most;
}

/* The squared length on which free skin decays; 0 where too little skin is free. */
static float squared_decay(const Cells *at, const Model *model, int n) {
    const float most = largest(at->smooth_depth, n), low = model->least_tail * most, high = model->most_tail * most;
    const float bend = model->most_decay * model->most_decay;
    double squares = 0.0, products = 0.0;
    int free = 0, some = 0;
    for (int k = 0; k < n; k++) {
        const float z = at->smooth_depth[k], curvature = at->curvature[k];
        if (!(at->mass[k] > 0.0f && z > low)) continue;
        some++;
        if (!(z < high && curvature > z / bend)) continue;
        free++;
        squares += (double)(z * z), products += (double)(z * curvature);
    }
    if (!((float)free > model->least_free * (float)some)) return 0.0f;
    const float sum = (float)products, squared = (float)squares / (sum > 1e-9f ? sum : 1e-9f);
    const float least_squared = model->least_decay * model->least_decay;
    return squared < least_squared ? least_squared : squared > bend ? bend : squared;
}

WIDE static void find_pressure(const float *restrict depth, const float *restrict curvature, const float *restrict mass, float decay, int n,
                               float *restrict pressure) {
    for (int k = 0; k < n; k++) pressure[k] = mass[k] > 0.0f ? depth[k] - decay * curvature[k] : 0.0f;
}

WIDE static void find_steepness(const float *restrict x, const float *restrict y, int n, float *restrict steep, float *restrict cubed) {
    for (int k = 0; k < n; k++) {
        steep[k] = x[k] * x[k] + y[k] * y[k];
        cubed[k] = steep[k] * sqrtf(steep[k]);
    }
}

/* A row of squared differences of slopes along the row from those of depth, between neighbouring cells of deformed skin. */
WIDE static void unexplained_in_row(const float *restrict mass, const float *restrict depth, const float *restrict slope, float cell_mm, int n,
                                    float *restrict squared) {
    for (int x = 0; x < n; x++) {
        const float apart = 0.5f * (slope[x + 1] + slope[x]) - (depth[x + 1] - depth[x]) / cell_mm;
        squared[x] = (mass[x] > 0.0f) & (mass[x + 1] > 0.0f) ? apart * apart : 0.0f;
    }
}

/* The same across rows, added: `below` cells on is the next row. */
WIDE static void unexplained_below(const float *restrict mass, const float *restrict depth, const float *restrict slope, float cell_mm, int below,
                                   int n, float *restrict squared) {
    for (int x = 0; x < n; x++) {
        const float apart = 0.5f * (slope[x + below] + slope[x]) - (depth[x + below] - depth[x]) / cell_mm;
        squared[x] += (mass[x] > 0.0f) & (mass[x + below] > 0.0f) ? apart * apart : 0.0f;
    }
}

WIDE static void square(const float *restrict values, int n, float *restrict squared) {
    for (int k = 0; k < n; k++) squared[k] = values[k] * values[k];
}

/* Cells whose slopes nearby are those of a surface. */
WIDE static void are_surface(const float *restrict unexplained, const float *restrict steep, const float *restrict squared, float most, float per,
                             int n, uint8_t *restrict surface) {
    for (int k = 0; k < n; k++) surface[k] = (uint8_t)((unexplained[k] < most * steep[k]) | (unexplained[k] < squared[k] / per));
}

/* unexplained() of ContactFromDepth, and where it is little enough, to at->surface. at->found holds the mean squared slope nearby. */
static void find_surface(const Cells *at, const Model *model, int reach) {
    const int rows = at->rows, columns = at->columns, n = rows * columns;
    const float per = model->noise_depth_mm * model->noise_depth_mm;
    for (int y = 0; y < rows; y++) {
        const size_t k = (size_t)y * columns;
        float *squared = at->squared + k;
        unexplained_in_row(at->mass + k, at->depth + k, at->slope_x + k, model->cell_mm, columns - 1, squared);
        squared[columns - 1] = 0.0f;
        if (y < rows - 1) unexplained_below(at->mass + k, at->depth + k, at->slope_y + k, model->cell_mm, columns, columns, squared);
    }
    box(at, at->squared, reach / 2, at->unexplained);
    square(at->depth, n, at->squared);
    box(at, at->squared, reach / 2, at->curvature);
    are_surface(at->unexplained, at->found, at->curvature, model->most_unexplained, per > 1e-9f ? per : 1e-9f, n, at->surface);
}

/* Cells that bear a pressure, as 1 and 0, to `pressed` and as floats to `result`. */
WIDE static void find_pressed(const float *restrict pressure, const float *restrict steep, const float *restrict cubed,
                              const uint8_t *restrict surface, float share, float most, int n, uint8_t *restrict pressed,
                              float *restrict result) {
    for (int k = 0; k < n; k++) {
        const float least_pressure = share * cubed[k] / (steep[k] > 1e-9f ? steep[k] : 1e-9f);
        const int is = surface[k] & (pressure[k] > least_pressure) & (pressure[k] > 0.1f * most);
        pressed[k] = (uint8_t)is;
        result[k] = (float)is;
    }
}

/* Cells of the rim, as 1 and 0, and their depth. */
WIDE static void find_rim(const float *restrict around, const float *restrict of, const float *restrict mass, const float *restrict depth, int n,
                          float *restrict rim, float *restrict level) {
    for (int k = 0; k < n; k++) {
        const float share = around[k] / (of[k] > 1e-6f ? of[k] : 1e-6f);
        rim[k] = (share > 0.2f) & (share < 0.8f) & (mass[k] > 0.0f) ? 1.0f : 0.0f;
        level[k] = rim[k] * depth[k];
    }
}

/* Depth of the rim of the contact nearby, to `level`: infinite where there is none. */
WIDE static void find_level(const float *restrict rim, const uint8_t *restrict pressed, int n, float *restrict level) {
    for (int k = 0; k < n; k++) {
        const float far = pressed[k] ? 0.0f : INFINITY;
        level[k] = rim[k] > 1e-9f ? level[k] / (rim[k] > 1e-9f ? rim[k] : 1e-9f) : far;
    }
}

WIDE static void some_of(const float *restrict mass, int n, float *restrict some) {
    for (int k = 0; k < n; k++) some[k] = mass[k] > 0.0f ? 1.0f : 0.0f;
}

/* Where no skin hangs free, all deformed skin lies on the object if slopes are those of a surface, and none if not. */
WIDE static void all_or_none(const uint8_t *restrict surface, int n, float *restrict level) {
    for (int k = 0; k < n; k++) level[k] = surface[k] ? -INFINITY : INFINITY;
}

/* rim_depth() of ContactFromDepth, to at->other. */
static void rim_depth(const Cells *at, const Model *model, int reach) {
    const int n = at->rows * at->columns;
    divide(at->slope_x, at->mass, 1e-6f, n), divide(at->slope_y, at->mass, 1e-6f, n);
    find_curvature(at, 2.0f * model->cell_mm);
    box(at, at->mass, 2, at->smooth_mass), box(at, at->depth, 2, at->smooth_depth), box(at, at->other, 2, at->curvature);
    divide(at->smooth_depth, at->smooth_mass, 1e-6f, n), divide(at->curvature, at->smooth_mass, 1e-6f, n);
    divide(at->depth, at->mass, 1e-6f, n);
    const float decay = squared_decay(at, model, n);
    if (decay > 0.0f) find_pressure(at->smooth_depth, at->curvature, at->mass, decay, n, at->pressure);
    find_steepness(at->slope_x, at->slope_y, n, at->smooth_mass, at->curvature);
    box(at, at->smooth_mass, reach / 2, at->found), box(at, at->curvature, reach / 2, at->other);
    find_surface(at, model, reach);
    if (decay == 0.0f) {
        all_or_none(at->surface, n, at->other);
        return;
    }
    find_pressed(at->pressure, at->found, at->other, at->surface, model->share * sqrtf(decay), largest(at->pressure, n), n, at->pressed,
                 at->smooth_mass);
    some_of(at->mass, n, at->curvature);
    box(at, at->smooth_mass, 1, at->found), box(at, at->curvature, 1, at->other);
    find_rim(at->found, at->other, at->mass, at->depth, n, at->smooth_mass, at->curvature);
    box(at, at->smooth_mass, reach, at->found), box(at, at->curvature, reach, at->other);
    find_level(at->found, at->pressed, n, at->other);
}

/* A row of pixels that are deformed and deeper than the rim. */
WIDE static void deeper(const uint8_t *restrict inside, const float *restrict depth, const float *restrict level, int n, uint8_t *restrict contact) {
    for (int x = 0; x < n; x++) contact[x] = inside[x] & (depth[x] > level[x]);
}

/* Means of whole cells; beyond the border all is zero. */
static void to_cells(const Cells *at, const uint8_t *inside, int64_t inside_row, const float *depth, int64_t depth_row, const float *gradient,
                     int rows, int columns, int cell) {
    const int whole = columns / cell, rest = columns - whole * cell;
    const size_t part = (size_t)rows * columns, n = (size_t)at->rows * at->columns;
    memset(at->mass, 0, 4 * sizeof(float) * n);
    for (int y = 0; y < rows; y++) {
        const size_t to = (size_t)(y / cell) * at->columns;
        const float *p = gradient + (size_t)y * columns, *q = p + part;
        const uint8_t *in = inside + inside_row * y;
        const float *z = depth + depth_row * y;
        add_pixels(in, z, p, q, cell, whole, at->mass + to, at->depth + to, at->slope_x + to, at->slope_y + to);
        const int last = whole * cell;
        for (int k = 0; k < rest; k++)
            add_pixels(in + last + k, z + last + k, p + last + k, q + last + k, 1, 1, at->mass + to + whole, at->depth + to + whole,
                       at->slope_x + to + whole, at->slope_y + to + whole);
    }
    if (cell > 1) scale(at->mass, 1.0f / (float)(cell * cell), (int)(4 * n));
}

static int allocate(Cells *at, int rows, int columns, int cell) {
    at->rows = (rows + cell - 1) / cell, at->columns = (columns + cell - 1) / cell;
    const size_t n = (size_t)at->rows * at->columns, line = (size_t)(at->columns + 1) * (size_t)(cell > ROWS ? cell : ROWS);
    at->mass = malloc(sizeof(float) * (13 * n + (size_t)at->columns + line));
    at->running = malloc(sizeof(double) * (size_t)at->columns);
    at->pressed = malloc(2 * n);
    if (!at->mass || !at->running || !at->pressed) return 1;
    at->depth = at->mass + n, at->slope_x = at->depth + n, at->slope_y = at->slope_x + n, at->curvature = at->slope_y + n;
    at->smooth_mass = at->curvature + n, at->smooth_depth = at->smooth_mass + n, at->pressure = at->smooth_depth + n;
    at->found = at->pressure + n, at->other = at->found + n, at->unexplained = at->other + n, at->squared = at->unexplained + n;
    at->sums = at->squared + n, at->line = at->sums + n + at->columns, at->surface = at->pressed + n;
    return 0;
}

/*
 * Contact, bytes (frames, rows, columns), of a window: depth and deformed (bytes) of it, frames and rows at the given distances; gradient
 * (frames, 2, rows, columns). numbers: in the order of Model. Returns 1 where memory is short.
 */
EXPORT int contact_from_depth(const float *depth, int64_t depth_frame, int64_t depth_row, const float *gradient, const uint8_t *deformed,
                              int64_t deformed_frame, int64_t deformed_row, int frames, int rows, int columns, int cell, int reach,
                              const float *numbers, uint8_t *contact) {
    const Model model = {numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]};
    const size_t part = (size_t)rows * columns;
    Cells at;
    const int short_of_memory = allocate(&at, rows, columns, cell);
    for (int b = 0; b < frames && !short_of_memory; b++, depth += depth_frame, deformed += deformed_frame, contact += part) {
        to_cells(&at, deformed, deformed_row, depth, depth_row, gradient + 2 * part * b, rows, columns, cell);
        rim_depth(&at, &model, reach);
        for (int y = 0; y < rows; y++) {
            uint8_t *to = contact + (size_t)y * columns;
            const float *level = at.other + (size_t)(y / cell) * at.columns;
            for (int x = 0; x < at.columns; x++)
                for (int k = 0; k < cell; k++) at.line[x * cell + k] = level[x];
            deeper(deformed + deformed_row * y, depth + depth_row * y, at.line, columns, to);
        }
    }
    free(at.mass), free(at.running), free(at.pressed);
    return short_of_memory;
}

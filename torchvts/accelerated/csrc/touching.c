/* Contact from depth: the same results as torchvts/contact/touching.py, which explains them. */
#include "kernels.h"

#include <math.h>

/* The settings of ContactFromDepth. */
typedef struct {
    float cell_mm, share, least_decay, most_decay, least_tail, most_tail, least_free, least_product, most_unexplained, noise_depth_mm, free_share, fall;
    int inner;
} Model;

/* Fields of rows x columns cells; `found` and `other` hold what is at hand. */
typedef struct {
    int rows, columns;
    float *mass, *depth, *slope_x, *slope_y, *curvature, *smooth_mass, *smooth_depth, *pressure, *found, *other, *unexplained, *squared, *bend;
    float *line;
    double *running;
    uint8_t *pressed, *surface, *lines;
} Cells;

/* A row of pixels added to a line of n cells of `cell` pixels each: how many are deformed, and their depth above an edge and slopes. Inlined with
   `cell` constant, loops over cells are vectorised. */
static inline __attribute__((always_inline)) void add_to_cells(const uint8_t *restrict inside, const float *restrict depth, const float *restrict p,
                                                               const float *restrict q, Edge edge, int cell, int n, float *restrict mass,
                                                               float *restrict z, float *restrict x, float *restrict y) {
    INDEPENDENT for (int j = 0; j < n; j++) {
        float mass_of = mass[j], z_of = z[j], x_of = x[j], y_of = y[j];
        UNROLLED for (int k = 0; k < cell; k++) {
            const int at = j * cell + k;
            const float in = (float)inside[at];
            mass_of += in, z_of += above_edge(edge, depth[at]) * in, x_of += p[at] * in, y_of += q[at] * in;
        }
        mass[j] = mass_of, z[j] = z_of, x[j] = x_of, y[j] = y_of;
    }
}

WIDE static void add_pixels(const uint8_t *inside, const float *depth, const float *p, const float *q, Edge edge, int cell, int n, float *mass,
                            float *z, float *x, float *y) {
    if (cell == 1)
        add_to_cells(inside, depth, p, q, edge, 1, n, mass, z, x, y);
    else if (cell == 2)
        add_to_cells(inside, depth, p, q, edge, 2, n, mass, z, x, y);
    else if (cell == 4)
        add_to_cells(inside, depth, p, q, edge, 4, n, mass, z, x, y);
    else
        add_to_cells(inside, depth, p, q, edge, cell, n, mass, z, x, y);
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

WIDE static void divide_by(float *restrict values, float by, int n) {
    for (int k = 0; k < n; k++) values[k] /= by;
}

/* Sums over `reach` rows either way, by running sums as torch rounds them; nothing lies beyond the border. running: a line; sums: the rows and one
   more. The result may take the values' place. */
static void sum_down(const float *values, int rows, int columns, int reach, double *running, float *sums, float *result) {
    memset(running, 0, sizeof(double) * (size_t)columns);
    memset(sums, 0, sizeof(float) * (size_t)columns);
    for (int y = 0; y < rows; y++) add_row(values + (size_t)y * columns, running, columns, sums + (size_t)(y + 1) * columns);
    for (int y = 0; y < rows; y++) {
        const int before = y > reach ? y - reach : 0, last = least(y + reach + 1, rows);
        subtract(sums + (size_t)last * columns, sums + (size_t)before * columns, columns, result + (size_t)y * columns);
    }
}

/* Rows become columns. */
static void turn(const float *values, int rows, int columns, float *turned) {
    const int fours = rows / 4 * 4, whole = columns / 4 * 4;
    for (int y = 0; y < fours; y += 4)
        for (int x = 0; x < whole; x += 4) transpose(values + (size_t)y * columns + x, (size_t)columns, turned + (size_t)x * rows + y, (size_t)rows);
    for (int y = 0; y < rows; y++)
        for (int x = y < fours ? whole : 0; x < columns; x++) turned[(size_t)x * rows + y] = values[(size_t)y * columns + x];
}

/* Doubles of memory for box(): a line of running sums, those sums of all lines, and the field turned. */
static size_t box_size(const Cells *at) {
    const size_t rows = (size_t)at->rows, columns = (size_t)at->columns;
    return (rows > columns ? rows : columns) + ((rows + 1) * (columns + 1) + rows * columns + 1) / 2;
}

/* Mean over `reach` cells either way; zero beyond the border. Sums along a row wait for one another, so rows become columns for them. */
static void box(const Cells *at, const float *values, int reach, float *result) {
    const int rows = at->rows, columns = at->columns, side = 2 * reach + 1;
    double *running = at->running;
    float *sums = (float *)(running + (rows > columns ? rows : columns)), *turned = sums + ((size_t)rows + 1) * ((size_t)columns + 1);
    sum_down(values, rows, columns, reach, running, sums, result);
    turn(result, rows, columns, turned);
    sum_down(turned, columns, rows, reach, running, sums, turned);
    turn(turned, columns, rows, result);
    divide_by(result, (float)(side * side), rows * columns);
}

/* One row of find_curvature(): slopes along x, and along y of this row and of those below and above, whose cells count where they have mass. */
WIDE static void curvature_row(const float *restrict x, const float *restrict here, const float *restrict below, const float *restrict above,
                               const float *restrict mass, const float *restrict mass_below, const float *restrict mass_above, float two_cells_mm,
                               int n, float *restrict curvature) {
    for (int k = 0; k < n; k++) {
        const float right = mass[k + 1] > 0.0f ? x[k + 1] : x[k], left = mass[k - 1] > 0.0f ? x[k - 1] : x[k];
        const float down = mass_below[k] > 0.0f ? below[k] : here[k], up = mass_above[k] > 0.0f ? above[k] : here[k];
        curvature[k] = (right - left + down - up) / two_cells_mm;
    }
}

/* Divergence of slopes to at->bend; beyond cells without deformed skin, and beyond the border, slopes go on as they are. */
static void find_curvature(const Cells *at, float two_cells_mm) {
    const int rows = at->rows, columns = at->columns, last = columns - 1;
    for (int y = 0; y < rows; y++) {
        const size_t row = (size_t)y * columns, below = y < rows - 1 ? row + columns : row, above = y > 0 ? row - columns : row;
        const float *x = at->slope_x + row, *mass = at->mass + row;
        if (columns > 2)
            curvature_row(x + 1, at->slope_y + row + 1, at->slope_y + below + 1, at->slope_y + above + 1, mass + 1, at->mass + below + 1,
                          at->mass + above + 1, two_cells_mm, columns - 2, at->bend + row + 1);
        for (int k = 0; k < columns; k += last > 0 ? last : 1) { /* the first and the last column */
            const float here = at->slope_y[row + k];
            const float right = k < last && mass[k + 1] > 0.0f ? x[k + 1] : x[k], left = k > 0 && mass[k - 1] > 0.0f ? x[k - 1] : x[k];
            const float down = at->mass[below + k] > 0.0f ? at->slope_y[below + k] : here, up = at->mass[above + k] > 0.0f ? at->slope_y[above + k] : here;
            at->bend[row + k] = (right - left + down - up) / two_cells_mm;
        }
    }
}

WIDE static void times(const float *restrict a, const float *restrict b, int n, float *restrict product) {
    for (int k = 0; k < n; k++) product[k] = a[k] * b[k];
}

WIDE static void divide(float *restrict values, const float *restrict by, float least_by, int n) {
    for (int k = 0; k < n; k++) values[k] /= by[k] > least_by ? by[k] : least_by;
}

static float largest(const float *values, int n) {
    float low, high;
    range_of(values, (size_t)n, &low, &high);
    return high;
}

enum { AT_ONCE = 16 };

/* Sums over free skin, whose depth lies between `low` and `high` and which bends as skin that decays at least as fast as `bend` says; and how many
   cells are deeper than `low`, how many of them shallow, less deep than `high`, and how many of these free. */
typedef struct {
    double squares, products;
    int some, shallow, free;
} FreeSkin;

WIDE static FreeSkin free_skin(const float *restrict depth, const float *restrict curvature, const float *restrict mass, float low, float high,
                               float bend, int n) {
    FreeSkin all = {0.0, 0.0, 0, 0, 0};
    float square[AT_ONCE], product[AT_ONCE];
    double squares[AT_ONCE] = {0.0}, products[AT_ONCE] = {0.0};
    for (int first = 0; first < n; first += AT_ONCE) {
        const int m = least(AT_ONCE, n - first);
        for (int k = 0; k < m; k++) {
            const float z = depth[first + k], c = curvature[first + k];
            const int is = (mass[first + k] > 0.0f) & (z > low), shallow = is & (z < high), hangs = shallow & (c > z / bend);
            square[k] = hangs ? z * z : 0.0f, product[k] = hangs ? z * c : 0.0f;
            all.some += is, all.shallow += shallow, all.free += hangs;
        }
        for (int k = 0; k < m; k++) squares[k] += (double)square[k], products[k] += (double)product[k];
    }
    for (int k = 0; k < AT_ONCE; k++) all.squares += squares[k], all.products += products[k];
    return all;
}

/* The squared length on which free skin decays; 0 where too little skin is free. */
static float squared_decay(const Cells *at, const Model *model, int n) {
    const float most = largest(at->smooth_depth, n), low = model->least_tail * most, high = model->most_tail * most;
    const float bend = model->most_decay * model->most_decay;
    const FreeSkin free = free_skin(at->smooth_depth, at->curvature, at->mass, low, high, bend, n);
    const float number = (float)free.free, some = (float)free.some;
    if (!(number > model->least_free * some || number * number > model->least_product * (some * (float)free.shallow))) return 0.0f;
    const float sum = (float)free.products, squared = (float)free.squares / (sum > 1e-9f ? sum : 1e-9f);
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
    square(at->depth, n, at->smooth_depth);
    box(at, at->squared, reach / 2, at->unexplained), box(at, at->smooth_depth, reach / 2, at->curvature);
    are_surface(at->unexplained, at->found, at->curvature, model->most_unexplained, per > 1e-9f ? per : 1e-9f, n, at->surface);
}

/* Cells that bear a pressure, as 1 and 0, to `pressed` and as floats to `counted`; their pressure to `inner`. */
WIDE static void find_pressed(const float *restrict pressure, const float *restrict steep, const float *restrict cubed,
                              const uint8_t *restrict surface, float share, float most, int n, uint8_t *restrict pressed,
                              float *restrict counted, float *restrict inner) {
    for (int k = 0; k < n; k++) {
        const float least_pressure = share * cubed[k] / (steep[k] > 1e-9f ? steep[k] : 1e-9f);
        const int is = surface[k] & (pressure[k] > least_pressure) & (pressure[k] > 0.1f * most);
        pressed[k] = (uint8_t)is;
        counted[k] = (float)is;
        inner[k] = (float)is * pressure[k];
    }
}

/* Of these the cells whose pressure exceeds a share of the mean of those nearby. */
WIDE static void above_fall(const float *restrict pressure, const float *restrict counted, const float *restrict inner, float fall, int n,
                            uint8_t *restrict pressed) {
    for (int k = 0; k < n; k++) pressed[k] &= pressure[k] > fall * (inner[k] / (counted[k] > 1e-6f ? counted[k] : 1e-6f));
}

/* A row of sums of three rows. */
WIDE static void add_three(const uint8_t *restrict above, const uint8_t *restrict row, const uint8_t *restrict below, int n, uint8_t *restrict sums) {
    for (int x = 0; x < n; x++) sums[x] = (uint8_t)(above[x] + row[x] + below[x]);
}

/* Of three neighbouring sums, the share of 3 x 3. */
WIDE static void share_of_nine(const uint8_t *restrict sums, int n, float *restrict share) {
    for (int x = 0; x < n; x++) share[x] = (float)(sums[x - 1] + sums[x] + sums[x + 1]) / 9.0f;
}

/* What box() of reach 1 gives of cells that are set. */
static void share_around(const Cells *at, const uint8_t *set, float *share) {
    const int rows = at->rows, columns = at->columns;
    uint8_t *none = at->lines, *sums = none + columns + 1;
    memset(none, 0, 2 * (size_t)columns + 2);
    for (int y = 0; y < rows; y++, set += columns) {
        add_three(y > 0 ? set - columns : none, set, y + 1 < rows ? set + columns : none, columns, sums);
        share_of_nine(sums, columns, share + (size_t)y * columns);
    }
}

WIDE static void exceed(const float *restrict values, float least, int n, uint8_t *restrict is) {
    for (int k = 0; k < n; k++) is[k] = values[k] > least;
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

/* Cells that are deeper than `low`. */
WIDE static void find_deep(const float *restrict depth, const float *restrict mass, float low, int n, float *restrict deep) {
    for (int k = 0; k < n; k++) deep[k] = (mass[k] > 0.0f) & (depth[k] > low) ? 1.0f : 0.0f;
}

/* Where no skin hangs free, all deformed skin near deep cells lies on the object if slopes are those of a surface, and none if not. */
WIDE static void all_or_none(const uint8_t *restrict surface, const float *restrict deep, int n, float *restrict level) {
    for (int k = 0; k < n; k++) level[k] = surface[k] & (deep[k] > 1e-3f) ? -INFINITY : INFINITY;
}

/* Cells deeper than the rim that bear too little pressure. */
WIDE static void find_free(const float *restrict bend, const float *restrict depth, const float *restrict level, float decay, float share, int n,
                           uint8_t *restrict free) {
    for (int k = 0; k < n; k++) free[k] = (decay * bend[k] > share * depth[k]) & (depth[k] > level[k]);
}

WIDE static void all_of(const uint8_t *restrict above, const uint8_t *restrict row, const uint8_t *restrict below, int n, uint8_t *restrict all) {
    for (int x = 0; x < n; x++) all[x] = above[x] & row[x] & below[x];
}

/* Where 3 x 3 such cells lie together, the level becomes infinite. */
static void free_within(const Cells *at, float share, float decay) {
    const int columns = at->columns;
    uint8_t *free = at->pressed, *all = at->surface;
    find_free(at->bend, at->depth, at->other, decay, share, at->rows * columns, free);
    for (int y = 1; y < at->rows - 1; y++, free += columns) {
        all_of(free, free + columns, free + 2 * columns, columns, all);
        for (int x = 1; x < columns - 1; x++) {
            if (!(all[x - 1] & all[x] & all[x + 1])) continue;
            for (int i = y - 1; i <= y + 1; i++)
                for (int j = x - 1; j <= x + 1; j++) at->other[(size_t)i * columns + j] = INFINITY;
        }
    }
}

/* rim_depth() of ContactFromDepth, to at->other. */
static void rim_depth(const Cells *at, const Model *model, int reach) {
    const int n = at->rows * at->columns;
    divide(at->slope_x, at->mass, 1e-6f, n), divide(at->slope_y, at->mass, 1e-6f, n);
    find_curvature(at, 2.0f * model->cell_mm);
    times(at->bend, at->mass, n, at->pressure);
    box(at, at->mass, 1, at->smooth_mass), box(at, at->depth, 1, at->smooth_depth), box(at, at->pressure, 1, at->curvature);
    divide(at->smooth_depth, at->smooth_mass, 1e-6f, n), divide(at->curvature, at->smooth_mass, 1e-6f, n);
    divide(at->depth, at->mass, 1e-6f, n);
    const float decay = squared_decay(at, model, n);
    float most = 0.0f;
    if (decay > 0.0f) {
        find_pressure(at->smooth_depth, at->curvature, at->mass, decay, n, at->pressure);
        most = largest(at->pressure, n);
        find_pressure(at->depth, at->bend, at->mass, decay, n, at->pressure);
    } else {
        find_deep(at->smooth_depth, at->mass, model->least_tail * largest(at->smooth_depth, n), n, at->pressure);
    }
    find_steepness(at->slope_x, at->slope_y, n, at->smooth_mass, at->curvature);
    box(at, at->smooth_mass, reach / 2, at->found), box(at, at->curvature, reach / 2, at->other);
    find_surface(at, model, reach);
    if (decay == 0.0f) {
        box(at, at->pressure, model->inner, at->found);
        all_or_none(at->surface, at->found, n, at->other);
        return;
    }
    find_pressed(at->pressure, at->found, at->other, at->surface, model->share * sqrtf(decay), most, n, at->pressed,
                 at->smooth_mass, at->curvature);
    box(at, at->smooth_mass, model->inner, at->found), box(at, at->curvature, model->inner, at->other);
    above_fall(at->pressure, at->found, at->other, model->fall, n, at->pressed);
    share_around(at, at->pressed, at->found), exceed(at->found, 0.5f, n, at->pressed);
    uint8_t *some = at->surface; /* which is not needed any more */
    exceed(at->mass, 0.0f, n, some);
    share_around(at, at->pressed, at->found), share_around(at, some, at->other);
    find_rim(at->found, at->other, at->mass, at->depth, n, at->smooth_mass, at->curvature);
    box(at, at->smooth_mass, reach, at->found), box(at, at->curvature, reach, at->other);
    find_level(at->found, at->pressed, n, at->other);
    free_within(at, model->free_share, decay);
}

/* A row of pixels that are deformed and, above the edge, deeper than the rim. */
WIDE static void deeper(const uint8_t *restrict inside, const float *restrict depth, const float *restrict level, Edge edge, int n,
                        uint8_t *restrict contact) {
    for (int x = 0; x < n; x++) contact[x] = inside[x] & (above_edge(edge, depth[x]) > level[x]);
}

/* One frame's window, and its cells. */
typedef struct {
    Cells at;
    const Touching *of;
    const Model *model;
    int bands;
} Frame;

/* Rows of cells of a band. */
static int first_row(const Frame *of, int band) { return of->at.rows * band / of->bands; }

/* Means of whole cells; beyond the border all is zero. */
static void to_cells(void *with, int band) {
    const Frame *frame = with;
    const Touching *of = frame->of;
    const Cells *at = &frame->at;
    const int columns = of->columns, cell = of->cell, whole = columns / cell, last = whole * cell;
    for (int i = first_row(frame, band); i < first_row(frame, band + 1); i++) {
        const size_t to = (size_t)i * at->columns;
        float *mass = at->mass + to, *depth = at->depth + to, *x = at->slope_x + to, *y = at->slope_y + to, *fields[4] = {mass, depth, x, y};
        for (int k = 0; k < 4; k++) memset(fields[k], 0, sizeof(float) * (size_t)at->columns);
        for (int line = i * cell; line < least((i + 1) * cell, of->rows); line++) {
            const float *p = of->gradient + (size_t)line * columns, *q = p + (size_t)of->rows * columns, *z = of->depth + of->depth_row * line;
            const uint8_t *in = of->deformed + of->deformed_row * line;
            add_pixels(in, z, p, q, of->edge, cell, whole, mass, depth, x, y);
            for (int k = last; k < columns; k++)
                add_pixels(in + k, z + k, p + k, q + k, of->edge, 1, 1, mass + whole, depth + whole, x + whole, y + whole);
        }
        for (int k = 0; k < 4 && cell > 1; k++) scale(fields[k], 1.0f / (float)(cell * cell), at->columns);
    }
}

/* Part 0: depth of the rim, which one thread finds; the others are the work beside it. */
static void rim_or_beside(void *with, int part) {
    const Frame *frame = with;
    if (part == 0)
        rim_depth(&frame->at, frame->model, frame->of->reach);
    else
        frame->of->beside(frame->of->with, part - 1);
}

/* Contact of the pixels of a band, by the rim's depth of their cells. */
static void to_pixels(void *with, int band) {
    const Frame *frame = with;
    const Touching *of = frame->of;
    const Cells *at = &frame->at;
    const int cell = of->cell;
    float *line = at->line + (size_t)band * at->columns * cell;
    for (int i = first_row(frame, band); i < first_row(frame, band + 1); i++) {
        const float *level = at->other + (size_t)i * at->columns;
        for (int x = 0; x < at->columns; x++)
            for (int k = 0; k < cell; k++) line[x * cell + k] = level[x];
        for (int y = i * cell; y < least((i + 1) * cell, of->rows); y++)
            deeper(of->deformed + of->deformed_row * y, of->depth + of->depth_row * y, line, of->edge, of->columns, of->contact + of->contact_row * y);
    }
}

static int allocate(Frame *frame) {
    Cells *at = &frame->at;
    const int cell = frame->of->cell;
    at->rows = (frame->of->rows + cell - 1) / cell, at->columns = (frame->of->columns + cell - 1) / cell;
    frame->bands = least(at->rows, bands_of(frame->of->rows));
    const size_t n = (size_t)at->rows * at->columns, line = (size_t)frame->bands * at->columns * cell;
    at->running = malloc(sizeof(double) * box_size(at) + sizeof(float) * (13 * n + line) + 2 * n + 2 * (size_t)at->columns + 2);
    if (!at->running) return 1;
    at->mass = (float *)(at->running + box_size(at));
    at->depth = at->mass + n, at->slope_x = at->depth + n, at->slope_y = at->slope_x + n, at->curvature = at->slope_y + n;
    at->smooth_mass = at->curvature + n, at->smooth_depth = at->smooth_mass + n, at->pressure = at->smooth_depth + n;
    at->found = at->pressure + n, at->other = at->found + n, at->unexplained = at->other + n, at->squared = at->unexplained + n;
    at->bend = at->squared + n, at->line = at->bend + n, at->pressed = (uint8_t *)(at->line + line), at->surface = at->pressed + n;
    at->lines = at->surface + n;
    return 0;
}

/* Contact of one frame, and the work beside it. Returns 1 where memory is short. */
int find_contact(const Touching *of) {
    const float *is = of->numbers;
    const Model model = {is[0], is[1], is[2], is[3], is[4], is[5], is[6], is[7], is[8], is[9], is[10], is[11], (int)is[12]};
    Frame frame = {.of = of, .model = &model};
    if (allocate(&frame)) return 1;
    share(to_cells, &frame, frame.bands);
    share(rim_or_beside, &frame, 1 + of->parts);
    share(to_pixels, &frame, frame.bands);
    free(frame.at.running);
    return 0;
}

/*
 * Contact, bytes (frames, rows, columns), of a window: depth and deformed (bytes) of it, frames and rows at the given distances; gradient
 * (frames, 2, rows, columns). numbers: in the order of Model. Returns 1 where memory is short.
 */
EXPORT int contact_from_depth(const float *depth, int64_t depth_frame, int64_t depth_row, const float *gradient, const uint8_t *deformed,
                              int64_t deformed_frame, int64_t deformed_row, int frames, int rows, int columns, int cell, int reach,
                              const float *numbers, uint8_t *contact) {
    const int64_t part = (int64_t)rows * columns;
    int short_of_memory = 0;
    for (int b = 0; b < frames && !short_of_memory; b++) {
        const Touching work = {.depth = depth + depth_frame * b, .depth_row = depth_row, .gradient = gradient + 2 * part * b,
                               .deformed = deformed + deformed_frame * b, .deformed_row = deformed_row, .rows = rows, .columns = columns, .cell = cell,
                               .reach = reach, .numbers = numbers, .edge = NO_EDGE, .contact = contact + part * b, .contact_row = columns};
        short_of_memory = find_contact(&work);
    }
    return short_of_memory;
}

/* A row of the tail without what is deeper than free skin, and of the core, which is the rest of the deformed area. */
WIDE static void split_row(const float *restrict depth, const uint8_t *restrict deformed, int n, float most, uint8_t *restrict tail, uint8_t *restrict core) {
    for (int x = 0; x < n; x++) {
        tail[x] = tail[x] & (depth[x] < most);
        core[x] = deformed[x] & (tail[x] ^ 1);
    }
}

/* Pixels of a row of the core that have one of the tail beside, above or below them. */
WIDE static void find_edge(const uint8_t *restrict core, const uint8_t *restrict tail, const uint8_t *restrict above, const uint8_t *restrict below, int n,
                           uint8_t *restrict edge) {
    edge[0] = core[0] & (tail[n > 1] | above[0] | below[0]);
    for (int x = 1; x + 1 < n; x++) edge[x] = core[x] & (tail[x - 1] | tail[x + 1] | above[x] | below[x]);
    edge[n - 1] = core[n - 1] & (tail[n > 1 ? n - 2 : 0] | above[n - 1] | below[n - 1]);
}

/* Adds the number of a row's pixels that are set, and returns the sum of their depth. */
WIDE static double sum_of(const float *restrict depth, const uint8_t *restrict set, int n, int *number) {
    float sums[AT_ONCE] = {0.0f}, total = 0.0f;
    int count = 0, x = 0;
    for (; x + AT_ONCE <= n; x += AT_ONCE) {
        float kept[AT_ONCE]; /* else the compiler does not vectorise */
        for (int k = 0; k < AT_ONCE; k++) kept[k] = (float)set[x + k] * depth[x + k], count += set[x + k];
        for (int k = 0; k < AT_ONCE; k++) sums[k] += kept[k];
    }
    for (; x < n; x++) total += (float)set[x] * depth[x], count += set[x];
    for (int k = 0; k < AT_ONCE; k++) total += sums[k];
    *number += count;
    return (double)total;
}

/* What above_tail() of torchvts/contact/touching.py finds, of a window of rows at this distance: the core, and the edge of the tail. Returns 0, and sets
   nothing, without a tail. The tail loses what is deeper than free skin. line: as many bytes as columns. */
int above_tail(const float *depth, const uint8_t *deformed, uint8_t *tail, int64_t width, int rows, int columns, float most_of_tail, uint8_t *core,
               uint8_t *line, Edge *edge) {
    int border = 0, any = 0;
    for (int y = 0; y < rows && !any; y++) any = memchr(tail + y * width, 1, (size_t)columns) != NULL;
    if (!any) return 0;
    float most = depth[0];
    for (int y = 0; y < rows; y++) {
        const float of_row = largest(depth + y * width, columns);
        most = of_row > most ? of_row : most;
    }
    for (int y = 0; y < rows; y++) split_row(depth + y * width, deformed + y * width, columns, most_of_tail * most, tail + y * width, core + y * width);
    double sum = 0.0;
    for (int y = 0; y < rows; y++) {
        const uint8_t *row = tail + y * width;
        find_edge(core + y * width, row, y > 0 ? row - width : row, y + 1 < rows ? row + width : row, columns, line);
        if (memchr(line, 1, (size_t)columns)) sum += sum_of(depth + y * width, line, columns, &border);
    }
    if (sum > 0.0) *edge = (Edge){(float)(sum / (double)border), 0.0f};
    return 1;
}

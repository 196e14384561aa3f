/* Depth that is zero on undeformed skin: the same results as torchvts/integration/background.py, which explains them. */
#include "kernels.h"

#include <math.h>

#define MOST_GRIDS 24

/* LEAST_LOW of background.py. */
#define LEAST_LOW 0.02f

/* What is known of a pixel. */
enum { DEFORMED = 0, FLAT = 1, RAISED = 2 };

/* One grid: rows x columns cells of so many pixels and a border of zeros around them, `wide` cells from row to row. Share on which the value is
   known, sum of known values, weight; then 1 over the mean weight of nine cells, weight * found, what was found, and the known part of that and
   the share of the rest. */
typedef struct {
    int rows, columns, wide;
    float pixels, *share, *value, *weight, *per_weight, *product, *found, *held, *open;
} Grid;

/* Pixels of a box: rows top to bottom, columns left to right, the ends outside. */
typedef struct {
    int top, bottom, left, right;
} Box;

static float *cell_of(const Grid *grid, float *field, int y) { return field + (size_t)(y + 1) * grid->wide + 1; }

/* Means over 2 x 2 cells of one field; beyond the border nothing is known. */
WIDE static void coarser(const Grid *fine, float *from, const Grid *grid, float *to) {
    for (int y = 0; y < grid->rows; y++) {
        const float *restrict upper = cell_of(fine, from, 2 * y), *restrict lower = cell_of(fine, from, 2 * y + 1);
        float *restrict line = cell_of(grid, to, y);
        for (int x = 0; x < grid->columns; x++) line[x] = 0.25f * (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1]);
    }
}

/* 1 over the weighted mean's weight, of nine cells each. */
WIDE static void weigh(Grid *grid) {
    const int wide = grid->wide;
    for (int y = 0; y < grid->rows; y++) {
        const float *w = cell_of(grid, grid->weight, y);
        float *restrict line = cell_of(grid, grid->per_weight, y);
        for (int x = 0; x < grid->columns; x++) {
            const float *at = w + x;
            const float mean = (at[-wide - 1] + at[-wide] + at[-wide + 1] + at[-1] + at[0] + at[1] + at[wide - 1] + at[wide] + at[wide + 1]) / 9.0f;
            line[x] = (1.0f / 9.0f) / (mean > 1e-9f ? mean : 1e-9f);
        }
    }
}

/* Cells in which a pixel or more is known get its value, those in which less is known a part of it. */
WIDE static void set_known(Grid *grid) {
    const size_t cells = (size_t)(grid->rows + 2) * grid->wide;
    const float *restrict share = grid->share, *restrict value = grid->value, pixels = grid->pixels;
    float *restrict found = grid->found, *restrict held = grid->held, *restrict open = grid->open;
    for (size_t k = 0; k < cells; k++) {
        const float known = share[k] * pixels, sure = known < 1.0f ? known : 1.0f;
        held[k] = sure * (value[k] / (share[k] > 1e-9f ? share[k] : 1e-9f));
        open[k] = 1.0f - sure;
        found[k] = held[k] + open[k] * found[k];
    }
}

/* The unknown part of cells becomes the weighted mean of the nine around them, once. */
WIDE static void relax(Grid *grid) {
    const int wide = grid->wide, columns = grid->columns;
    const size_t cells = (size_t)(grid->rows + 2) * wide;
    const float *restrict weight = grid->weight, *restrict before = grid->found;
    float *restrict product = grid->product;
    for (size_t k = 0; k < cells; k++) product[k] = weight[k] * before[k];
    for (int y = 0; y < grid->rows; y++) {
        const float *p = cell_of(grid, grid->product, y), *restrict held = cell_of(grid, grid->held, y);
        const float *restrict open = cell_of(grid, grid->open, y), *restrict per_weight = cell_of(grid, grid->per_weight, y);
        float *restrict found = cell_of(grid, grid->found, y);
        for (int x = 0; x < columns; x++) {
            const float *at = p + x;
            const float sum = at[-wide - 1] + at[-wide] + at[-wide + 1] + at[-1] + at[0] + at[1] + at[wide - 1] + at[wide] + at[wide + 1];
            found[x] = held[x] + open[x] * (sum * per_weight[x]);
        }
    }
}

WIDE static void between(const float *restrict upper, const float *restrict lower, float down, int n, float *restrict line) {
    const float up = 1.0f - down;
    for (int x = 0; x < n; x++) line[x] = up * upper[x] + down * lower[x];
}

/* A line between the two rows of a grid around pixel row y of one that is `scale` times finer; a cell beyond either end repeats it. */
static void between_rows(const Grid *grid, int y, float scale, float *line) {
    float at = ((float)y + 0.5f) / scale - 0.5f;
    if (at < 0.0f) at = 0.0f;
    const int top = least((int)at, grid->rows - 1);
    between(cell_of(grid, grid->found, top), cell_of(grid, grid->found, least(top + 1, grid->rows - 1)), at - (float)top, grid->columns, line + 1);
    line[0] = line[1], line[grid->columns + 1] = line[grid->columns];
}

/* What was found on the next coarser grid. `line`: as many floats as that has columns, and two more. */
static void refine(const Grid *coarse, Grid *grid, float *line) {
    for (int y = 0; y < grid->rows; y++) {
        between_rows(coarse, y, 2.0f, line);
        float *restrict found = cell_of(grid, grid->found, y);
        for (int x = 0; x < grid->columns / 2; x++) {
            found[2 * x] = 0.25f * line[x] + 0.75f * line[x + 1];
            found[2 * x + 1] = 0.75f * line[x + 1] + 0.25f * line[x + 2];
        }
        if (grid->columns % 2) found[grid->columns - 1] = 0.25f * line[grid->columns / 2] + 0.75f * line[grid->columns / 2 + 1];
    }
}

/* Fills grids[0].found from its known cells, by way of the coarser grids. */
static void continued(Grid *grids, int count, int sweeps, float *line) {
    for (int k = 1; k < count; k++) {
        coarser(&grids[k - 1], grids[k - 1].share, &grids[k], grids[k].share);
        coarser(&grids[k - 1], grids[k - 1].value, &grids[k], grids[k].value);
    }
    for (int k = count - 1; k >= 0; k--) {
        Grid *grid = &grids[k];
        if (k == count - 1) {
            float share = 0.0f, value = 0.0f;
            for (int y = 0; y < grid->rows; y++)
                for (int x = 0; x < grid->columns; x++) share += cell_of(grid, grid->share, y)[x], value += cell_of(grid, grid->value, y)[x];
            for (int y = 0; y < grid->rows; y++)
                for (int x = 0; x < grid->columns; x++) cell_of(grid, grid->found, y)[x] = value / (share > 1e-9f ? share : 1e-9f);
        } else {
            refine(&grids[k + 1], grid, line);
        }
        set_known(grid);
        for (int sweep = 0; sweep < sweeps; sweep++) relax(grid);
    }
}

WIDE static void any_of_five(const uint8_t *restrict a, const uint8_t *restrict b, const uint8_t *restrict c, const uint8_t *restrict d,
                             const uint8_t *restrict e, uint8_t flipped, int n, uint8_t *restrict result) {
    for (int x = 0; x < n; x++) result[x] = (a[x] | b[x] | c[x] | d[x] | e[x]) ^ flipped;
}

/* Row y: 1 at pixels within two of which none is deformed, else 0. scratch: two lines, and four bytes each. */
static void not_beside(const uint8_t *deformed, int height, int width, int y, uint8_t *scratch, uint8_t *flat) {
    const size_t wide = (size_t)width + 4;
    uint8_t *column = scratch, *none = scratch + wide;
    const uint8_t *line[5];
    memset(column, 0, 2 * wide);
    for (int k = 0; k < 5; k++) line[k] = y + k < 2 || y + k >= height + 2 ? none : deformed + (size_t)(y + k - 2) * width;
    any_of_five(line[0], line[1], line[2], line[3], line[4], 0, width, column + 2);
    any_of_five(column, column + 1, column + 2, column + 3, column + 4, 1, width, flat);
}

enum { LANES = 16 };

/* The bits of a float as a whole number of the same order: loops over such are vectorised, those over floats are not. Its own inverse. */
static inline int32_t in_order(int32_t bits) { return bits ^ (bits >> 31 & 0x7fffffff); }

WIDE static void find_range(const float *values, size_t n, float *lowest, float *highest) {
    int32_t low = INT32_MAX, high = INT32_MIN;
    for (size_t k = 0; k < n; k++) {
        union {
            float value;
            int32_t bits;
        } here = {values[k]};
        const int32_t at = in_order(here.bits);
        low = at < low ? at : low;
        high = at > high ? at : high;
    }
    low = in_order(low), high = in_order(high);
    memcpy(lowest, &low, sizeof low), memcpy(highest, &high, sizeof high);
}

/* Smallest and largest of n values. */
void range_of(const float *values, size_t n, float *lowest, float *highest) { find_range(values, n, lowest, highest); }

enum { BLOCK = 256 };

/* Sum and count of a row's undeformed pixels below `middle`; others of them are marked as raised: a face of the object. Block by block, since loops
   over bytes and floats are vectorised, but not with such sums among them. */
WIDE static void flat_row(const float *restrict depth, uint8_t *restrict kind, float middle, int n, float *sum, int *count) {
    float total = 0.0f, lanes[LANES] = {0.0f}, flat[BLOCK];
    int found = 0;
    for (int first = 0; first < n; first += BLOCK, depth += BLOCK, kind += BLOCK) {
        const int some = least(BLOCK, n - first);
        int k = 0;
        for (int x = 0; x < some; x++) {
            const int is = (kind[x] != DEFORMED) & (depth[x] < middle);
            flat[x] = (float)is * depth[x];
            found += is;
            kind[x] = kind[x] == DEFORMED ? DEFORMED : is ? FLAT : RAISED;
        }
        for (; k + LANES <= some; k += LANES)
            for (int j = 0; j < LANES; j++) lanes[j] += flat[k + j];
        for (; k < some; k++) total += flat[k];
    }
    for (int j = 0; j < LANES; j++) total += lanes[j];
    *sum = total, *count = found;
}

/* Whether raised skin is a face of the object: what is flat beside it is no pocket, and deformed skin is most of what lies around it, and more
   than so many pixels. */
static int is_face(const uint8_t *kind, int height, int width, int64_t more_than) {
    int64_t around[3] = {0}, of_kind[3] = {0};
    for (size_t k = 0; k < (size_t)height * width; k++) of_kind[kind[k]]++;
    if (of_kind[FLAT] > 0 && (float)of_kind[FLAT] < LEAST_LOW * (float)(of_kind[FLAT] + of_kind[RAISED])) return 0;
    for (int y = 0; y < height; y++) {
        const uint8_t *row = kind + (size_t)y * width;
        const int top = y > 0 ? y - 1 : 0, bottom = y < height - 1 ? y + 1 : y;
        int near = 0;
        for (int i = top; i <= bottom && !near; i++) near = memchr(kind + (size_t)i * width, RAISED, (size_t)width) != NULL;
        for (int x = 0; near && x < width; x++) {
            const int left = x > 0 ? x - 1 : 0, right = x < width - 1 ? x + 1 : x;
            int beside = 0;
            for (int i = top; i <= bottom; i++)
                for (int j = left; j <= right; j++) beside |= kind[(size_t)i * width + j] == RAISED;
            around[row[x]] += beside;
        }
    }
    return around[DEFORMED] > around[FLAT] && around[DEFORMED] > more_than;
}

/* A row of pixels added to the sums of cells' columns. */
WIDE static void add_row(const float *restrict depth, const uint8_t *restrict kind, float level, float per_range, float stiff, int n,
                         float *restrict share, float *restrict value, float *restrict weight) {
    for (int x = 0; x < n; x++) {
        float above = (depth[x] - level) * per_range;
        above = above > 0.0f ? above : 0.0f;
        share[x] += kind[x] == DEFORMED ? 0.0f : 1.0f;
        value[x] += kind[x] == FLAT ? depth[x] : kind[x] == RAISED ? level : 0.0f;
        weight[x] += 1.0f + stiff * above * above;
    }
}

/* Deformed pixels of a row that lie below what was found by more than a tolerance, added in the same way: a quarter, from twice as far below on. Returns
   whether there are any. */
WIDE static int add_below(const float *restrict depth, const uint8_t *restrict kind, const float *restrict found, float per_tolerance, int n,
                          float *restrict share, float *restrict value) {
    int any = 0;
    for (int x = 0; x < n; x++) {
        const float low = (found[x] - depth[x]) * per_tolerance - 1.0f;
        const float known = kind[x] == DEFORMED && low > 0.0f ? 0.25f * (low < 1.0f ? low : 1.0f) : 0.0f;
        share[x] += known;
        value[x] += known * depth[x];
        any |= known > 0.0f;
    }
    return any;
}

WIDE static void take_out(const float *restrict depth, const uint8_t *restrict kind, const float *restrict found, int n, float *restrict out) {
    for (int x = 0; x < n; x++) out[x] = kind[x] == FLAT ? 0.0f : depth[x] - found[x];
}

/* Sums of `cell` columns each, times `scale`, added. */
static void add_columns(const float *columns, int n, int cell, float scale, float *sums) {
    if (cell == 1)
        for (int x = 0; x < n; x++) sums[x] += scale * columns[x];
    else if (cell == 4)
        for (int x = 0; x < n; x++) sums[x] += scale * (columns[4 * x] + columns[4 * x + 1] + columns[4 * x + 2] + columns[4 * x + 3]);
    else
        for (int x = 0; x < n; x++) {
            float sum = 0.0f;
            for (int k = 0; k < cell; k++) sum += columns[x * cell + k];
            sums[x] += scale * sum;
        }
}

/* Between the middles of cells, pixel by pixel: the cell to the left, and how far to the next. */
WIDE static void along_row(const float *restrict line, const int32_t *restrict place, const float *restrict along, int n, float *restrict found) {
    for (int x = 0; x < n; x++) {
        const float here = line[place[x]], next = line[place[x] + 1];
        found[x] = here + along[x] * (next - here);
    }
}

/* The smallest box of all pixels that are not flat. */
static Box not_flat(const uint8_t *kind, int height, int width) {
    Box box = {height, 0, width, 0};
    for (int y = 0; y < height; y++) {
        const uint8_t *row = kind + (size_t)y * width;
        const int left = bytes_alike(row, width, FLAT);
        int right = width;
        if (left == width) continue;
        while (right - 64 > box.right && bytes_alike(row + right - 64, 64, FLAT) == 64) right -= 64;
        while (right > box.right && row[right - 1] == FLAT) right--;
        box.top = least(box.top, y), box.bottom = y + 1;
        box.left = least(box.left, left), box.right = right > box.right ? right : box.right;
    }
    return box;
}

/* One call: grids, pixels' kinds, where pixels lie between cells, the sum and number of flat pixels of each row, and of each band of rows the
   smallest and largest depth, sums of columns and lines. Then the frame at hand. */
typedef struct {
    Grid grids[MOST_GRIDS];
    int count, cell, height, width, bands;
    float *memory, *along, *flat_sum, *band_memory, *line;
    int32_t *place, *flat_count;
    uint8_t *kind, *scratch;
    const float *depth;
    const uint8_t *deformed;
    float *out;
    float level, middle, high, range, stiff, per_tolerance;
    Box box;
    atomic_int below;
} Work;

/* Floats that a band of rows has for itself: sums of columns, a line of cells, and one of pixels. */
static size_t band_size(const Work *work) {
    const size_t columns = (size_t)work->grids[0].columns;
    return 3 * columns * work->cell + columns + 2 + (size_t)work->width + 2;
}

static int allocate(Work *work, int height, int width) {
    const int cell = least(height, width) / 60 > 1 ? least(height, width) / 60 : 1;
    int rows = (height + cell - 1) / cell, columns = (width + cell - 1) / cell;
    const size_t first = (size_t)columns + 2;
    size_t cells = 0;
    work->cell = cell, work->count = 0;
    for (; work->count < MOST_GRIDS; rows = (rows + 1) / 2, columns = (columns + 1) / 2) {
        Grid *grid = &work->grids[work->count++];
        /* an odd number gets a cell of zeros more, so that every cell of the next grid has four */
        grid->rows = rows, grid->columns = columns, grid->wide = columns + 3;
        grid->pixels = work->count == 1 ? (float)(cell * cell) : 4.0f * grid[-1].pixels;
        cells += (size_t)(rows + 3) * grid->wide;
        if (least(rows, columns) <= 2) break;
    }
    work->height = height, work->width = width;
    work->bands = least(work->grids[0].rows, bands_of(height));
    work->memory = calloc(8 * cells + (size_t)work->bands * band_size(work) + first + 2 * (size_t)width + 2 * (size_t)height, sizeof(float));
    work->kind = malloc((size_t)height * width + (size_t)work->bands * 2 * ((size_t)width + 4));
    if (!work->memory || !work->kind) return 1;
    work->scratch = work->kind + (size_t)height * width;
    float *place = work->memory;
    for (int k = 0; k < work->count; k++) {
        Grid *grid = &work->grids[k];
        const size_t size = (size_t)(grid->rows + 3) * grid->wide;
        grid->share = place, grid->value = place + size, grid->weight = place + 2 * size, grid->per_weight = place + 3 * size;
        grid->product = place + 4 * size, grid->found = place + 5 * size, grid->held = place + 6 * size, grid->open = place + 7 * size;
        place += 8 * size;
    }
    work->band_memory = place, work->line = place + (size_t)work->bands * band_size(work), work->along = work->line + first;
    work->place = (int32_t *)(work->along + width), work->flat_sum = (float *)(work->place + width);
    work->flat_count = (int32_t *)(work->flat_sum + height);
    for (int x = 0; x < width; x++) {
        float at = ((float)x + 0.5f) / (float)cell - 0.5f;
        if (at < 0.0f) at = 0.0f;
        work->place[x] = (int)at + 1; /* the line begins with a cell more */
        work->along[x] = at - (float)(int)at;
    }
    return 0;
}

/* Memory of a band of rows, and its rows of cells and pixels. */
typedef struct {
    float *share, *value, *weight, *line, *found;
    int first, last, top, bottom;
} Band;

static Band band_of(Work *work, int band) {
    const Grid *grid = &work->grids[0];
    const size_t lines = (size_t)grid->columns * work->cell;
    float *memory = work->band_memory + (size_t)band * band_size(work);
    Band of = {memory, memory + lines, memory + 2 * lines, memory + 3 * lines, memory + 3 * lines + grid->columns + 2, 0, 0, 0, 0};
    of.first = grid->rows * band / work->bands, of.last = grid->rows * (band + 1) / work->bands;
    of.top = of.first * work->cell, of.bottom = least(of.last * work->cell, work->height);
    return of;
}

/* The continuation at the pixels of row y from `left` to `right`. */
static const float *continuation(const Work *work, Band *band, int y, int left, int right) {
    const Grid *grid = &work->grids[0];
    if (work->cell == 1) return cell_of(grid, grid->found, y) + left;
    between_rows(grid, y, (float)work->cell, band->line);
    along_row(band->line, work->place + left, work->along + left, right - left, band->found);
    return band->found;
}

/* Kinds of a band's pixels, and the sum and number of flat pixels of each of its rows. */
static void find_kinds(void *with, int part) {
    Work *work = with;
    const Band band = band_of(work, part);
    uint8_t *scratch = work->scratch + (size_t)part * 2 * ((size_t)work->width + 4);
    for (int y = band.top; y < band.bottom; y++) {
        uint8_t *kind = work->kind + (size_t)y * work->width;
        not_beside(work->deformed, work->height, work->width, y, scratch, kind);
        flat_row(work->depth + (size_t)y * work->width, kind, work->middle, work->width, work->flat_sum + y, work->flat_count + y);
    }
}

/* Kinds of pixels, and the mean depth of flat skin. Undeformed pixels are marked as flat, or as raised where they are a face of the object above the middle. */
static float level_of(Work *work) {
    const size_t pixels = (size_t)work->height * work->width;
    double sum = 0.0;
    int64_t flat = 0;
    share(find_kinds, work, work->bands);
    for (int y = 0; y < work->height; y++) sum += work->flat_sum[y], flat += work->flat_count[y];
    if (memchr(work->kind, RAISED, pixels) && !is_face(work->kind, work->height, work->width, 0)) {
        for (size_t k = 0; k < pixels; k++) {
            if (work->kind[k] != RAISED) continue;
            work->kind[k] = FLAT;
            sum += work->depth[k], flat++;
        }
    }
    return flat ? (float)(sum / (double)flat) : 0.0f;
}

/* Pixels of a kind along the four sides of the image. */
static int64_t on_border(const uint8_t *kind, int height, int width, uint8_t of) {
    const uint8_t *last = kind + (size_t)(height - 1) * width;
    int64_t found = 0;
    for (int x = 0; x < width; x++) found += (kind[x] == of) + (last[x] == of);
    for (int y = 0; y < height; y++) found += (kind[(size_t)y * width] == of) + (kind[(size_t)(y + 1) * width - 1] == of);
    return found;
}

WIDE static void add_above(const float *restrict depth, float middle, size_t n, uint8_t *restrict deformed) {
    for (size_t k = 0; k < n; k++) deformed[k] |= depth[k] >= middle;
}

WIDE static int any_above(const float *restrict depth, const uint8_t *restrict deformed, float middle, size_t n) {
    int any = 0;
    for (size_t k = 0; k < n; k++) any |= (depth[k] >= middle) & !deformed[k];
    return any;
}

enum { PIECES = 8 };

/* Smallest and largest depth of each of so many pieces of a frame; whether undeformed skin lies above the middle. */
typedef struct {
    const float *depth;
    const uint8_t *deformed;
    size_t pixels;
    float low[PIECES], high[PIECES], middle;
    atomic_int any;
} Ends;

static void ends_of(void *with, int k) {
    Ends *of = with;
    const size_t first = of->pixels * (size_t)k / PIECES;
    range_of(of->depth + first, of->pixels * ((size_t)k + 1) / PIECES - first, of->low + k, of->high + k);
}

static void any_in_piece(void *with, int k) {
    Ends *of = with;
    const size_t first = of->pixels * (size_t)k / PIECES, pixels = of->pixels * ((size_t)k + 1) / PIECES - first;
    if (!of->any && any_above(of->depth + first, of->deformed + first, of->middle, pixels)) of->any = 1;
}

/* Smallest and largest depth of a frame. */
static void find_ends(Ends *of, float found[2]) {
    share(ends_of, of, PIECES);
    found[0] = of->low[PIECES - 1], found[1] = of->high[PIECES - 1]; /* which has a pixel; pieces without any have no numbers */
    for (int k = 0; k < PIECES - 1; k++) {
        found[0] = of->low[k] < found[0] ? of->low[k] : found[0];
        found[1] = of->high[k] > found[1] ? of->high[k] : found[1];
    }
}

/* with_faces() of background.py, in place; and the smallest and the largest depth to `ends`. kind: a byte for each pixel, and two lines, and four bytes
   each. Returns whether there are such faces. */
int add_faces(const float *depth, uint8_t *deformed, int height, int width, uint8_t *kind, float ends[2]) {
    const size_t pixels = (size_t)height * width;
    Ends of = {.depth = depth, .deformed = deformed, .pixels = pixels};
    find_ends(&of, ends);
    const float middle = of.middle = 0.5f * (ends[0] + ends[1]); /* half of the frame's depth */
    share(any_in_piece, &of, PIECES);
    if (!of.any) return 0;
    float sum;
    int count;
    for (int y = 0; y < height; y++) not_beside(deformed, height, width, y, kind + pixels, kind + (size_t)y * width);
    for (int y = 0; y < height; y++) flat_row(depth + (size_t)y * width, kind + (size_t)y * width, middle, width, &sum, &count);
    if (!memchr(kind, RAISED, pixels) || !memchr(kind, FLAT, pixels)) return 0;
    const int64_t along = on_border(deformed, height, width, 1) ? 0 : on_border(kind, height, width, RAISED);
    if (!is_face(kind, height, width, along)) return 0;
    add_above(depth, middle, pixels, deformed);
    return 1;
}

/* The undeformed skin's shares, values and weights of a band's cells. */
static void fill_cells(void *with, int part) {
    Work *work = with;
    Grid *grid = &work->grids[0];
    const Band band = band_of(work, part);
    const int cell = work->cell, width = work->width;
    const size_t lines = (size_t)grid->columns * cell;
    const float per_cell = 1.0f / (float)(cell * cell);
    for (int i = band.first; i < band.last; i++) {
        memset(band.share, 0, 3 * sizeof(float) * lines);
        for (int y = i * cell; y < least((i + 1) * cell, work->height); y++)
            add_row(work->depth + (size_t)y * width, work->kind + (size_t)y * width, work->level, 1.0f / work->range, work->stiff, width, band.share,
                    band.value, band.weight);
        float *share_of = cell_of(grid, grid->share, i), *value = cell_of(grid, grid->value, i), *weight = cell_of(grid, grid->weight, i);
        memset(share_of, 0, sizeof(float) * (size_t)grid->columns);
        memset(value, 0, sizeof(float) * (size_t)grid->columns);
        memset(weight, 0, sizeof(float) * (size_t)grid->columns);
        add_columns(band.share, grid->columns, cell, per_cell, share_of);
        add_columns(band.value, grid->columns, cell, per_cell, value);
        add_columns(band.weight, grid->columns, cell, per_cell, weight);
    }
}

/* Kinds of pixels, the mean depth of flat skin, the range above it, and the undeformed skin's cells; all weights. */
static void known_cells(Work *work) {
    work->level = level_of(work);
    work->range = work->high - work->level > 1e-9f ? work->high - work->level : 1e-9f;
    share(fill_cells, work, work->bands);
    for (int k = 0; k < work->count; k++) {
        if (k > 0) coarser(&work->grids[k - 1], work->grids[k - 1].weight, &work->grids[k], work->grids[k].weight);
        weigh(&work->grids[k]);
    }
}

/* Deformed skin of a band that lies well below the continuation counts as known too. */
static void add_known(void *with, int part) {
    Work *work = with;
    Grid *grid = &work->grids[0];
    Band band = band_of(work, part);
    const Box box = work->box;
    const int cell = work->cell, width = work->width;
    const size_t lines = (size_t)grid->columns * cell;
    const float per_cell = 1.0f / (float)(cell * cell);
    for (int i = band.first; i < band.last; i++) {
        memset(band.share, 0, 2 * sizeof(float) * lines);
        int here = 0;
        for (int y = i * cell > box.top ? i * cell : box.top; y < least((i + 1) * cell, box.bottom); y++) {
            const float *found = continuation(work, &band, y, box.left, box.right);
            const size_t at = (size_t)y * width + box.left;
            here |= add_below(work->depth + at, work->kind + at, found, work->per_tolerance, box.right - box.left, band.share + box.left,
                              band.value + box.left);
        }
        if (!here) continue;
        work->below = 1;
        add_columns(band.share, grid->columns, cell, per_cell, cell_of(grid, grid->share, i));
        add_columns(band.value, grid->columns, cell, per_cell, cell_of(grid, grid->value, i));
    }
}

/* A band of the result, which is zero outside of the box. */
static void write_out(void *with, int part) {
    Work *work = with;
    Band band = band_of(work, part);
    const Box box = work->box;
    for (int y = band.top; y < band.bottom; y++) {
        const size_t row = (size_t)y * work->width, at = row + box.left;
        if (y < box.top || y >= box.bottom) {
            memset(work->out + row, 0, sizeof(float) * (size_t)work->width);
            continue;
        }
        memset(work->out + row, 0, sizeof(float) * (size_t)box.left);
        take_out(work->depth + at, work->kind + at, continuation(work, &band, y, box.left, box.right), box.right - box.left, work->out + at);
        memset(work->out + row + box.right, 0, sizeof(float) * (size_t)(work->width - box.right));
    }
}

/* zero_background() of one frame. ends: the smallest and the largest depth, or null. */
int zero_frame(const float *depth, const uint8_t *deformed, int height, int width, float stiff, float tolerance, int sweeps, const float *ends,
               float *out) {
    Work work = {.depth = depth, .deformed = deformed, .out = out, .stiff = stiff};
    const int short_of_memory = allocate(&work, height, width);
    if (!short_of_memory) {
        Ends of = {.depth = depth, .pixels = (size_t)height * width};
        float found[2];
        if (!ends) find_ends(&of, found), ends = found;
        work.middle = 0.5f * (ends[0] + ends[1]), work.high = ends[1];
        known_cells(&work);
        work.per_tolerance = 1.0f / (tolerance * work.range);
        work.box = not_flat(work.kind, height, width);
        if (work.box.bottom > 0) { /* else all skin is flat */
            continued(work.grids, work.count, sweeps, work.line);
            share(add_known, &work, work.bands);
            if (work.below) continued(work.grids, work.count, sweeps, work.line);
        }
        share(write_out, &work, work.bands);
    }
    free(work.memory), free(work.kind);
    return short_of_memory;
}

/*
 * depth (frames, height, width) with what slopes leave beside a contact taken out, to out. deformed: bytes. Returns 1 where memory is
 * short.
 */
EXPORT int zero_background(const float *depth, const uint8_t *deformed, int frames, int height, int width, float stiff, float tolerance,
                           int sweeps, float *out) {
    const size_t pixels = (size_t)height * width;
    int short_of_memory = 0;
    for (int b = 0; b < frames && !short_of_memory; b++)
        short_of_memory = zero_frame(depth + pixels * b, deformed + pixels * b, height, width, stiff, tolerance, sweeps, NULL, out + pixels * b);
    return short_of_memory;
}

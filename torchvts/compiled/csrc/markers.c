/* Printed markers, found and filled: torchvts/model/markers.py, which explains it. */
#include "plan.h"

/* An image of cells of pixels, in which markers are looked for: (height, width); `reach`: pixels that the planes are wider on each side. */
typedef struct {
    int height, width, cell, reach;
    double diameter; /* of a marker, in cells */
} Cells;

static Cells cells_of(int64_t height, int64_t width, double diameter_px) {
    const int cell = diameter_px >= 16.0 ? (int)(diameter_px / 8.0) : 1, reach = (int)(diameter_px / cell + 0.5);
    return (Cells){(int)((height + cell - 1) / cell), (int)((width + cell - 1) / cell), cell, reach > 2 ? reach : 2, diameter_px / cell};
}

int markers_fit(const Plan *plan) {
    if (!(plan->marker_diameter < MOST_SIDE)) return 0;
    const Cells of = cells_of(plan->height, plan->width, plan->marker_diameter);
    return plan->marker_diameter == 0.0 || least(of.height, of.width) > of.reach;
}

/* The logarithm of a normal positive number to half a unit of its last place, alike on all processors. */
static inline float log_of(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    const int32_t exponent = (int32_t)(bits - 0x3f3504f3u) >> 23; /* what is left lies between 1 / sqrt 2 and sqrt 2 */
    bits -= (uint32_t)exponent << 23;
    memcpy(&value, &bits, sizeof value);
    const double s = ((double)value - 1.0) / ((double)value + 1.0), q = s * s;
    return (float)(exponent * 0.69314718055994531 + 2.0 * s * (1.0 + q * (1.0 / 3 + q * (1.0 / 5 + q * (1.0 / 7 + q * (1.0 / 9 + q * (1.0 / 11)))))));
}

static inline float mean_of_nine(const float *above, const float *here, const float *below, int left, int x, int right) {
    return (above[left] + above[x] + above[right] + here[left] + here[x] + here[right] + below[left] + below[x] + below[right]) / 9.0f;
}

/* _log_light(): of a plane, to rows that are `step` apart. */
static WIDE void log_light(const float *plane, int height, int width, const Cells *of, float *restrict light, size_t step) {
    for (int y = 0; y < of->height; y++, light += step) {
        if (of->cell == 1) {
            const float *here = plane + (size_t)y * width, *above = y ? here - width : here, *below = y < height - 1 ? here + width : here;
            for (int x = 1; x < width - 1; x++) light[x] = mean_of_nine(above, here, below, x - 1, x, x + 1);
            light[0] = mean_of_nine(above, here, below, 0, 0, 1), light[width - 1] = mean_of_nine(above, here, below, width - 2, width - 1, width - 1);
        } else
            for (int x = 0; x < of->width; x++) {
                const int bottom = least((y + 1) * of->cell, height), right = least((x + 1) * of->cell, width);
                float sum = 0.0f;
                for (int i = y * of->cell; i < bottom; i++)
                    for (int j = x * of->cell; j < right; j++) sum += plane[(size_t)i * width + j];
                light[x] = sum / (float)((bottom - y * of->cell) * (right - x * of->cell));
            }
        for (int x = 0; x < of->width; x++) light[x] = log_of(light[x] + 0.03f);
    }
}

/* Completes a plane of rows `step` apart by its reflection; from: its first pixel. */
static void reflect(const Cells *of, float *from, size_t step) {
    for (int y = 0; y < of->height; y++)
        for (int k = 1; k <= of->reach; k++) from[y * step - k] = from[y * step + k], from[y * step + of->width - 1 + k] = from[y * step + of->width - 1 - k];
    float *row = from - of->reach;
    for (int k = 1; k <= of->reach; k++) {
        memcpy(row - k * step, row + k * step, sizeof(float) * step);
        memcpy(row + (of->height - 1 + k) * step, row + (of->height - 1 - k) * step, sizeof(float) * step);
    }
}

static inline float smaller(float a, float b) { return a < b ? a : b; }

static inline float darkest_sides(const float *a, const size_t *away, int x) {
    const float row = smaller(a[x + away[0]] + a[x - away[0]], a[x + away[1]] + a[x - away[1]]);
    return smaller(row, smaller(a[x + away[2]] + a[x - away[2]], a[x + away[3]] + a[x - away[3]]));
}

static inline float darkest_side(const float *a, const size_t *away, int x) {
    float found = a[x + away[0]];
    UNROLLED for (int k = 0; k < 4; k++) found = smaller(found, smaller(a[x + away[k]], a[x - away[k]]));
    return found;
}

/* _marker_depth(): of a row of three channels and their mean, `plane` apart; away: of the pixels on one side, in four directions. */
static WIDE void marker_depth(const float *light, size_t plane, const size_t *away, int width, float *restrict strict, float *restrict mean) {
    const float *a = light, *b = a + plane, *c = b + plane, *grey = c + plane;
    const size_t o[4] = {away[0], away[1], away[2], away[3]};
    for (int x = 0; x < width; x++) {
        const float p = 0.5f * darkest_sides(a, o, x) - a[x], q = 0.5f * darkest_sides(b, o, x) - b[x], r = 0.5f * darkest_sides(c, o, x) - c[x];
        mean[x] = (p + q + r) / 3.0f;
        strict[x] = darkest_side(grey, o, x) - grey[x] > 0.2f * mean[x] ? smaller(p, smaller(q, r)) : -9.0f;
    }
}

/* The largest of `size` values, `step` apart, from each of n on, in place, by windows that double; (size - 1) * step values more follow. */
static WIDE void largest_of(float *values, size_t n, size_t step, int size) {
    for (int done = 1; done < size;) {
        const int more = least(done, size - done);
        const size_t left = n + (size_t)(size - done - more) * step, apart = (size_t)more * step;
        INDEPENDENT for (size_t k = 0; k < left; k++) values[k] = values[k] > values[k + apart] ? values[k] : values[k + apart];
        done += more;
    }
}

/* The largest value within `down` rows and `across` columns of each; none is below 0. */
static int largest_around(Scratch *scratch, const float *plane, int height, int width, int down, int across, float *found) {
    const size_t before = scratch->used, step = (size_t)width + 2 * across, all = step * (height + 2 * down);
    float *wide = lend(scratch, sizeof(float) * all);
    if (!wide) return NO_MEMORY;
    memset(wide, 0, sizeof(float) * all);
    for (int y = 0; y < height; y++) memcpy(wide + (y + down) * step + across, plane + (size_t)y * width, sizeof(float) * width);
    largest_of(wide, all - 2 * across, 1, 2 * across + 1);
    largest_of(wide, height * step - 2 * across, step, 2 * down + 1);
    for (int y = 0; y < height; y++) memcpy(found + (size_t)y * width, wide + y * step, sizeof(float) * width);
    give_back(scratch, before);
    return DONE;
}

/* _octagon_max(), in place; some: height * width floats. */
static int octagon_around(Scratch *scratch, float *plane, int height, int width, int reach, float *some) {
    const int half = reach / 2;
    if (largest_around(scratch, plane, height, width, half, half, some) || largest_around(scratch, some, height, width, 0, reach - half, plane) ||
        largest_around(scratch, some, height, width, reach - half, 0, some))
        return NO_MEMORY;
    for (size_t k = 0; k < (size_t)height * width; k++) plane[k] = plane[k] > some[k] ? plane[k] : some[k];
    return DONE;
}

/* Means of 2 x 2 pixels, fewer at the border: of a plane times its weight, over `share`; or of the weight where these are null. line: `width` floats. */
static WIDE void halve(const float *plane, const float *weight, const float *share, int height, int width, float *restrict line, float *restrict means) {
    for (int y = 0; y < height; y += 2) {
        const int rows = least(2, height - y), pairs = width / 2;
        const float *a = plane ? plane + (size_t)y * width : NULL, *w = weight + (size_t)y * width;
        for (int x = 0; x < width; x++) line[x] = a ? a[x] * w[x] : w[x];
        for (int x = 0; x < width && rows == 2; x++) line[x] += a ? a[width + x] * w[width + x] : w[width + x];
        for (int x = 0; x < pairs; x++) means[x] = (line[2 * x] + line[2 * x + 1]) / (float)(2 * rows);
        if (width % 2) means[pairs] = line[width - 1] / (float)rows;
        for (int x = 0; x < pairs + width % 2 && share; x++) means[x] /= share[x] > 1e-6f ? share[x] : 1e-6f;
        means += pairs + width % 2, share = share ? share + pairs + width % 2 : NULL;
    }
}

/* A row of `width` pixels from one of half as many, between whose pixels it is a line. */
static WIDE void widen_row(const float *restrict coarse, int width, float *restrict row) {
    const int columns = (width + 1) / 2;
    const float across = (float)columns / (float)width;
    for (int x = 0; x < width; x++) {
        const float place = x ? across * ((float)x + 0.5f) - 0.5f : 0.0f, u = place - (float)(int)place;
        row[x] = (1.0f - u) * coarse[(int)place] + u * coarse[least((int)place + 1, columns - 1)];
    }
}

/* Holes of a row become what lies between two others. */
static WIDE void blend_row(const float *restrict a, const float *restrict b, const float *restrict weight, float v, int width, float *restrict row) {
    for (int x = 0; x < width; x++) row[x] = weight[x] == 0.0f ? (1.0f - v) * a[x] + v * b[x] : row[x];
}

/* Holes take the values of a plane of half the size, between whose pixels they are lines. lines: 2 * width floats. */
static void take_coarse(const float *coarse, const float *weight, int height, int width, float *lines, float *plane) {
    const int rows = (height + 1) / 2, columns = (width + 1) / 2;
    for (int y = 0, next = 0; y < height; y++, weight += width, plane += width) {
        const float place = y ? (float)rows / (float)height * ((float)y + 0.5f) - 0.5f : 0.0f;
        const int i = (int)place, below = least(i + 1, rows - 1);
        for (; next <= below; next++) widen_row(coarse + (size_t)next * columns, width, lines + next % 2 * width);
        blend_row(lines + i % 2 * width, lines + below % 2 * width, weight, place - (float)i, width, plane);
    }
}

/* Holes become the mean of their four neighbours. */
static WIDE void relax(const float *restrict plane, const float *restrict weight, int height, int width, float *restrict relaxed) {
    for (int y = 0; y < height; y++, plane += width, weight += width, relaxed += width) {
        const float *above = y ? plane - width : plane, *below = y < height - 1 ? plane + width : plane;
        for (int x = 1; x < width - 1; x++) {
            const float mean = 0.25f * (plane[x - 1] + plane[x + 1] + above[x] + below[x]);
            relaxed[x] = weight[x] == 0.0f ? mean : plane[x];
        }
        for (int x = 0; x < width; x += width > 1 ? width - 1 : 1)
            relaxed[x] = weight[x] == 0.0f ? 0.25f * (plane[x ? x - 1 : x] + plane[x < width - 1 ? x + 1 : x] + above[x] + below[x]) : plane[x];
    }
}

/* fill_markers(): the pixels of planes whose weight is 0 are filled from around them, in place. An even number of relaxations. */
static int fill_holes(Scratch *scratch, float *planes, int count, const float *weight, int height, int width, int relaxations) {
    const int rows = (height + 1) / 2, columns = (width + 1) / 2;
    const size_t pixels = (size_t)height * width, cells = (size_t)rows * columns, before = scratch->used;
    size_t hole = 0;
    while (hole < pixels && weight[hole] != 0.0f) hole++;
    if (hole == pixels || pixels == 1) return DONE;
    float *coarse = lend(scratch, sizeof(float) * ((size_t)(count + 1) * cells + pixels + 2 * (size_t)width));
    if (!coarse) return NO_MEMORY;
    float *share = coarse + count * cells, *other = share + cells, *lines = other + pixels;
    halve(NULL, weight, NULL, height, width, lines, share);
    for (int c = 0; c < count; c++) halve(planes + c * pixels, weight, share, height, width, lines, coarse + c * cells);
    const int code = fill_holes(scratch, coarse, count, share, rows, columns, relaxations);
    for (int c = 0; c < count && code == DONE; c++) {
        float *plane = planes + c * pixels;
        take_coarse(coarse + c * cells, weight, height, width, lines, plane);
        for (int k = 0; k < relaxations; k += 2) relax(plane, weight, height, width, other), relax(other, weight, height, width, plane);
    }
    give_back(scratch, before);
    return code;
}

/* Depths of markers at cells: candidates for one, `candidate`, where there are any; else 0. */
static int find_candidates(const Cells *of, float least_depth, const float *strict, const float *mean, float *candidate) {
    const size_t n = (size_t)of->height * of->width;
    double sum = 0.0, squares = 0.0;
    int64_t count = 0;
    for (size_t k = 0; k < n; k++)
        if (strict[k] > least_depth) sum += strict[k], squares += (double)(strict[k] * strict[k]), count++;
    const float usual = (float)(squares / fmax(sum, 1e-6)), twice = 2.0f * least_depth, share = 0.4f * usual;
    const int others = (double)count > 4.0 * of->diameter * of->diameter;
    for (size_t k = 0; k < n; k++) {
        const int hidden = others & (mean[k] > twice) & (mean[k] > share) & (strict[k] > -0.5f * mean[k]);
        candidate[k] = (strict[k] > least_depth) | hidden ? fmaxf(mean[k], 0.0f) : 0.0f;
    }
    return count > 0;
}

/* Marker depths of the cells of an image, strict and mean, and the least that counts; grey: mean log light of cells. */
static int find_depths(const Plan *plan, Scratch *scratch, const Cells *of, const float *image, float *strict, float *mean, float *grey, float *least_depth) {
    const int h = of->height, w = of->width, slant = (int)(0.7071 * of->diameter + 0.5);
    const size_t n = (size_t)h * w, reach = (size_t)of->reach, step = w + 2 * reach, size = step * (h + 2 * reach), near = slant > 1 ? (size_t)slant : 1;
    const size_t away[] = {reach, reach * step, near * step + near, near * step - near}, before = scratch->used;
    float *some = lend(scratch, sizeof(float) * (4 * size + 2 * n)), noise = 0.0f;
    if (!some) return NO_MEMORY;
    float *first = some + 2 * n + reach * step + reach;
    for (int c = 0; c < 3; c++) {
        log_light(image + c * (size_t)plan->height * plan->width, (int)plan->height, (int)plan->width, of, first + c * size, step);
        for (int y = 0; y < h; y++) memcpy(grey + y * (size_t)w, first + c * size + y * step, sizeof(float) * w);
        const float found = noise_of(grey, h, w, some);
        noise = noise > found ? noise : found;
    }
    for (int y = 0; y < h; y++) {
        float *row = first + y * step, *last = row + 3 * size;
        for (int x = 0; x < w; x++) last[x] = (row[x] + row[size + x] + row[2 * size + x]) / 3.0f;
        memcpy(grey + y * (size_t)w, last, sizeof(float) * w);
    }
    for (int c = 0; c < 4; c++) reflect(of, first + c * size, step);
    for (int y = 0; y < h; y++) marker_depth(first + y * step, size, away, w, strict + y * (size_t)w, mean + y * (size_t)w);
    *least_depth = fmaxf((float)plan->marker_sigmas * noise, (float)plan->marker_contrast);
    give_back(scratch, before);
    return DONE;
}

/* Of each value, whether it is above 0 and this share of the largest within `half` cells: 1 or 0. */
static int near_largest(Scratch *scratch, const float *values, int height, int width, int half, float share, float *found) {
    if (largest_around(scratch, values, height, width, half, half, found)) return NO_MEMORY;
    for (size_t k = 0; k < (size_t)height * width; k++) found[k] = values[k] > share * found[k];
    return DONE;
}

/* find_markers(), of cells: 1 where a marker is, else 0; some: 5 * cells floats. *any: whether there are markers. */
static int find_cells(const Plan *plan, Scratch *scratch, const Cells *of, const float *image, float *some, float *mask, int *any) {
    const int h = of->height, w = of->width, middle = (int)(0.5 * of->diameter + 0.5), half = middle > 1 ? middle : 1, around = (int)(0.35 * of->diameter + 0.5);
    const size_t n = (size_t)h * w;
    float *strict = some, *mean = strict + n, *grey = mean + n, *candidate = grey + n, *other = candidate + n, least_depth;
    if (find_depths(plan, scratch, of, image, strict, mean, grey, &least_depth)) return NO_MEMORY;
    *any = find_candidates(of, least_depth, strict, mean, candidate);
    if (!*any) return DONE;
    if (near_largest(scratch, candidate, h, w, half, 0.5f, mask) || octagon_around(scratch, mask, h, w, around > 2 ? around : 2, other)) return NO_MEMORY;
    /* nearby pixels that are darker than a first filling */
    float *filled = strict, *outside = mean, *drop = candidate;
    memcpy(filled, grey, sizeof(float) * n);
    for (size_t k = 0; k < n; k++) outside[k] = 1.0f - mask[k];
    if (fill_holes(scratch, filled, 1, outside, h, w, 2)) return NO_MEMORY;
    for (size_t k = 0; k < n; k++) drop[k] = filled[k] > grey[k] ? filled[k] - grey[k] : 0.0f;
    return near_largest(scratch, drop, h, w, half, 0.2f, mask);
}

int fill_markers(const Plan *plan, Scratch *scratch, const float *image, float *filled) {
    const int height = (int)plan->height, width = (int)plan->width, margin = (int)(plan->marker_margin * plan->marker_diameter + 0.5);
    const Cells of = cells_of(height, width, plan->marker_diameter);
    const size_t pixels = (size_t)height * width, before = scratch->used;
    float *cells = lend(scratch, sizeof(float) * 6 * pixels), *mask = cells + pixels, *some = mask + pixels;
    int any = 0, code = cells ? find_cells(plan, scratch, &of, image, mask, cells, &any) : NO_MEMORY;
    if (filled != image) memcpy(filled, image, 3 * sizeof(float) * pixels);
    if (code == DONE && any) {
        for (int y = 0; y < height; y++)
            for (int j = 0, x = 0; j < of.width; j++)
                for (; x < least((j + 1) * of.cell, width); x++) mask[(size_t)y * width + x] = cells[(size_t)(y / of.cell) * of.width + j];
        code = octagon_around(scratch, mask, height, width, margin > 1 ? margin : 1, some);
        for (size_t k = 0; k < pixels; k++) mask[k] = 1.0f - mask[k];
        if (code == DONE) code = fill_holes(scratch, filled, 3, mask, height, width, 4);
    }
    give_back(scratch, before);
    return code;
}

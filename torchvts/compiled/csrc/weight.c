/* How surely the skin has moved: ContactMask of torchvts/skin/weight.py, which explains it. */
#include "plan.h"

/* Sums of each `cell` values of a line. */
static WIDE void sum_cells(const float *restrict line, int cell, int columns, float *restrict sums) {
    for (int j = 0; j < columns; j++) sums[j] = line[(size_t)j * cell];
    for (int k = 1; k < cell; k++)
        for (int j = 0; j < columns; j++) sums[j] += line[(size_t)j * cell + k];
}

static WIDE void add_line(const float *restrict values, int n, float *restrict line) {
    for (int x = 0; x < n; x++) line[x] += values[x];
}

/* Means over whole cells (rows, columns) of a plane whose lines have `width` pixels; line: `width` floats. */
void cell_means(const float *plane, int width, int cell, int rows, int columns, float *line, float *means) {
    for (int i = 0; i < rows; i++, means += columns) {
        memcpy(line, plane + (size_t)i * cell * width, sizeof(float) * (size_t)width);
        for (int y = i * cell + 1; y < (i + 1) * cell; y++) add_line(plane + (size_t)y * width, width, line);
        sum_cells(line, cell, columns, means);
        for (int j = 0; j < columns; j++) means[j] /= (float)(cell * cell);
    }
}

/* Values between the middles of two cells, `cell` of them from `from` on. */
static inline void between(float one, float other, int cell, const float *along, float *line) {
    for (int k = 0; k < cell; k++) line[k] = one + along[k] * (other - one);
}

/* An image of cells (rows, columns), interpolated between their middles; beyond them as there. some: columns + cell floats. */
WIDE void to_pixels(const float *cells, int rows, int columns, int cell, int height, int width, float *some, float *image) {
    float *blended = some, *along = some + columns;
    const int middle = cell / 2; /* of the first pixel behind the middle of a cell */
    for (int k = 0; k < cell; k++) along[k] = ((float)(k + middle) + 0.5f) / (float)cell - 0.5f;
    for (int y = 0; y < height; y++, image += width) {
        const float place = fminf(fmaxf(((float)y + 0.5f) / (float)cell - 0.5f, 0.0f), (float)(rows - 1));
        const int top = least((int)place, rows - 1), below = least(top + 1, rows - 1);
        const float down = place - (float)top, *upper = cells + (size_t)top * columns, *lower = cells + (size_t)below * columns;
        for (int x = 0; x < columns; x++) blended[x] = upper[x] + down * (lower[x] - upper[x]);
        int at = 0;
        for (; at < middle; at++) image[at] = blended[0];
        for (int j = 0; j + 1 < columns; j++, at += cell) {
            if (cell == 4)
                between(blended[j], blended[j + 1], 4, along, image + at);
            else if (cell == 8)
                between(blended[j], blended[j + 1], 8, along, image + at);
            else
                between(blended[j], blended[j + 1], cell, along, image + at);
        }
        for (; at < width; at++) image[at] = blended[columns - 1];
    }
}

/* spread_of() of weight.py: of the absolute values of n means. some: 2 n floats. */
static float spread_of(const Plan *plan, const float *means, int n, float *some) {
    for (int k = 0; k < n; k++) some[k] = fabsf(means[k]) + 1e-6f;
    const float *ordered = sorted(some, some + n, n), square = (float)plan->square_within, within = (float)plan->within;
    const float fewest = (float)(plan->fewest * n), smallest = (float)plan->least_spread;
    double sum = 0.0;
    float spread = smallest;
    for (int k = 0; k < n; k++) {
        sum += (double)(ordered[k] * ordered[k]);
        spread = sqrtf((float)sum / (square * (float)(k + 1)));
        spread = spread > smallest ? spread : smallest;
        if (k + 1 < n && ordered[k + 1] > within * spread && (float)(k + 1) >= fewest) break;
    }
    return spread;
}

/* The most of the spread of means (rows, columns) that is noise, which neighbours do not share. some: 2 n floats. */
static float rough_spread(const Plan *plan, const float *means, int rows, int columns, float *some) {
    const int n = rows * (columns - 1);
    for (int y = 0, k = 0; y < rows; y++)
        for (int x = 1; x < columns; x++) some[k++] = fabsf(means[y * columns + x] - means[y * columns + x - 1]);
    return n > 0 ? (float)plan->rough * sorted(some, some + n, n)[n / 2] : 0.0f;
}

/* Length of vectors of `parts` planes (rows, columns), each in units of its spread; `beside` is a spread of its own that each has, or null. Returns the
   largest spread. */
static WIDE float lengths(const Plan *plan, const float *means, int parts, const float *beside, int rows, int columns, float *some, float *length) {
    const int n = rows * columns;
    const float least = (float)fmax(plan->most_spread, plan->least_spread);
    float largest = 0.0f;
    memset(length, 0, sizeof(float) * (size_t)n);
    for (int c = 0; c < parts; c++, means += n) {
        const float spread = spread_of(plan, means, n, some);
        const int bounded = spread > least && spread < (float)plan->hanging; /* few frames are: noise need not be sorted for the others */
        const float taken = bounded ? fminf(spread, fmaxf(rough_spread(plan, means, rows, columns, some), least)) : spread, square = taken * taken;
        largest = spread > largest ? spread : largest;
        if (beside)
            for (int k = 0; k < n; k++) length[k] += means[k] * means[k] / (square + beside[k] * beside[k]);
        else
            for (int k = 0; k < n; k++) length[k] += means[k] * means[k] / square;
    }
    for (int k = 0; k < n; k++) length[k] = sqrtf(0.5f * length[k] + 1e-12f);
    return largest;
}

/* Adds a row's relative change of light. */
static WIDE void add_change(const float *restrict image, const float *restrict flat, const float *restrict per_light, int n, float *restrict line) {
    for (int x = 0; x < n; x++) line[x] += (image[x] - flat[x]) * per_light[x];
}

/* Means of the relative change of light, less their mean over the channels (3, n), and the share of that mean which is no colour. */
static void change_of_colour(const Plan *plan, const float *light, int rows, int columns, float *line, float *change, float *grey) {
    const int width = (int)plan->width, cell = (int)plan->mask_cell, n = rows * columns;
    const size_t pixels = (size_t)plan->height * width;
    for (int c = 0; c < 3; c++) {
        float *to = change + (size_t)n * c;
        double total = 0.0;
        for (int i = 0; i < rows; i++) {
            memset(line, 0, sizeof(float) * (size_t)width);
            for (int y = i * cell; y < (i + 1) * cell; y++) {
                const size_t at = pixels * c + (size_t)y * width;
                add_change(light + at, plan->mask_flat + at, plan->per_light + at, width, line);
            }
            sum_cells(line, cell, columns, to + (size_t)i * columns);
        }
        for (int k = 0; k < n; k++) to[k] /= (float)(cell * cell), total += to[k];
        if (!((float)(total / n) > (float)(plan->failed_light - 1.0))) memset(to, 0, sizeof(float) * (size_t)n);
    }
    for (int k = 0; k < n; k++) {
        const float mean = (change[k] + change[n + k] + change[2 * n + k]) / 3.0f;
        for (int c = 0; c < 3; c++) change[c * n + k] -= mean;
        grey[k] = (float)plan->grey_share * mean;
    }
}

/* reconstruct() of core/morphology.py: marks what is connected to a seed over edges. kept: 1 seeds, 0 else; stack: n places. */
static void connect(const float *weight, int rows, int columns, uint8_t *kept, int32_t *stack) {
    int size = 0;
    for (int k = 0; k < rows * columns; k++)
        if (kept[k]) stack[size++] = k;
    while (size) {
        const int at = stack[--size], x = at % columns, y = at / columns;
        const int beside[4] = {x > 0 ? at - 1 : -1, x < columns - 1 ? at + 1 : -1, y > 0 ? at - columns : -1, y < rows - 1 ? at + columns : -1};
        for (int k = 0; k < 4; k++)
            if (beside[k] >= 0 && !kept[beside[k]] && weight[beside[k]] > 0.0f) kept[beside[k]] = 1, stack[size++] = beside[k];
    }
}

/* Rows of cells and zeros around them: 3 x 3 sums, or the largest of 3 x 3; some: columns + 2 floats. */
static WIDE void around(const float *cells, int rows, int columns, int largest, float *some, float *found) {
    for (int y = 0; y < rows; y++) {
        const float *here = cells + (size_t)y * columns, *above = y ? here - columns : NULL, *below = y < rows - 1 ? here + columns : NULL;
        float *line = some + 1, *to = found + (size_t)y * columns;
        some[0] = line[columns] = 0.0f;
        memcpy(line, here, sizeof(float) * (size_t)columns);
        for (int k = 0; k < 2; k++) {
            const float *other = k ? below : above;
            for (int x = 0; x < columns && other; x++) line[x] = !largest ? line[x] + other[x] : line[x] > other[x] ? line[x] : other[x];
        }
        for (int x = 0; x < columns; x++) {
            const float beside = line[x - 1] > line[x + 1] ? line[x - 1] : line[x + 1];
            to[x] = !largest ? line[x - 1] + line[x] + line[x + 1] : line[x] > beside ? line[x] : beside;
        }
    }
}

/* ContactMask.weight(): of the evidence of cells, to `wide`; sure, weight: n floats, some: columns + 2. */
static WIDE void rise(const Plan *plan, const float *evidence, int rows, int columns, float *sure, float *weight, float *some, uint8_t *kept, int32_t *stack,
                      float *wide) {
    const float from = (float)plan->rise_from, steepness = (float)(plan->rise_to - plan->rise_from), sigmas = (float)plan->sigmas;
    const int n = rows * columns;
    for (int k = 0; k < n; k++) {
        const float risen = (evidence[k] - from) / steepness, positive = risen > 0.0f ? risen : 0.0f;
        weight[k] = positive < 1.0f ? positive : 1.0f;
        sure[k] = evidence[k] > sigmas ? 1.0f : 0.0f;
    }
    around(sure, rows, columns, 0, some, wide);
    for (int k = 0; k < n; k++) kept[k] = (uint8_t)((sure[k] > 0.0f) & (wide[k] > 1.5f) & (weight[k] > 0.0f));
    connect(weight, rows, columns, kept, stack);
    for (int k = 0; k < n; k++) weight[k] *= (float)kept[k];
    around(weight, rows, columns, 1, some, wide);
}

int weigh(const Plan *plan, Scratch *scratch, const float *light, const float *gradient, float *unseen, float *weight) {
    const int height = (int)plan->height, width = (int)plan->width, cell = (int)plan->mask_cell;
    const int rows = height / cell, columns = width / cell, n = rows * columns;
    const size_t before = scratch->used;
    float *change = lend(scratch, sizeof(float) * (8 * (size_t)n + (size_t)width + (size_t)columns + (size_t)cell) + (sizeof(int32_t) + 1) * (size_t)n);
    if (!change) return NO_MEMORY;
    float *grey = change + 3 * (size_t)n, *some = grey + n, *evidence = some + 2 * (size_t)n, *other = evidence + n, *line = other + n;
    int32_t *stack = (int32_t *)(line + width + columns + cell);
    uint8_t *kept = (uint8_t *)(stack + n);
    int code = DONE;
    if (plan->by_colour || !plan->takes_slopes) {
        change_of_colour(plan, light, rows, columns, line, change, grey);
        lengths(plan, change, 3, grey, rows, columns, some, evidence);
    }
    *unseen = NAN;
    if (plan->takes_slopes) {
        for (int c = 0; c < 2; c++) cell_means(gradient + (size_t)c * height * width, width, cell, rows, columns, line, change + (size_t)c * n);
        *unseen = (float)plan->rise_to * lengths(plan, change, 2, NULL, rows, columns, some, other);
        for (int k = 0; k < n; k++) evidence[k] = plan->by_colour ? fminf(evidence[k], other[k]) : other[k];
    }
    for (int k = 0; k < n; k++) evidence[k] *= plan->mask_noise[k];
    code = blur_plane(scratch, evidence, plan->mask_blur, (int)plan->mask_taps, rows, columns, other);
    if (code == DONE) {
        rise(plan, other, rows, columns, change, change + n, some, kept, stack, evidence);
        to_pixels(evidence, rows, columns, cell, height, width, line, weight);
    }
    give_back(scratch, before);
    return code;
}

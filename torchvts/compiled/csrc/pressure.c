/* Where the object touches the skin: moved() of torchvts/skin/weight.py and ContactFromDepth of torchvts/skin/pressure.py, which explain it. */
#include "plan.h"

static WIDE float largest(const float *values, size_t n, int absolute) {
    float most[16], found;
    for (int k = 0; k < 16; k++) most[k] = absolute ? 0.0f : values[0];
    size_t at = 0;
    for (; at + 16 <= n; at += 16)
        for (int k = 0; k < 16; k++) {
            const float value = absolute ? fabsf(values[at + k]) : values[at + k];
            most[k] = value > most[k] ? value : most[k];
        }
    for (; at < n; at++) {
        const float value = absolute ? fabsf(values[at]) : values[at];
        most[0] = value > most[0] ? value : most[0];
    }
    found = most[0];
    for (int k = 1; k < 16; k++) found = most[k] > found ? most[k] : found;
    return found;
}

WIDE void find_moved(const Plan *plan, const float *weight, const float *depth, uint8_t *deformed) {
    const size_t pixels = (size_t)plan->height * plan->width;
    const float found = largest(depth, pixels, 1), deepest = found > 1e-9f ? found : 1e-9f;
    const float shallow = (float)plan->moved_depth * deepest, deep = 0.5f * deepest;
    for (size_t k = 0; k < pixels; k++) deformed[k] = (uint8_t)(((weight[k] > 0.5f) & (fabsf(depth[k]) > shallow)) | (depth[k] > deep));
}

/* Five-point Laplacian of depth (rows, columns) with a free border, times `scale`. */
static WIDE void curvature_of(const float *depth, float scale, int rows, int columns, float *curvature) {
    for (int y = 0; y < rows; y++) {
        const float *here = depth + (size_t)y * columns, *above = y ? here - columns : here, *below = y < rows - 1 ? here + columns : here;
        float *to = curvature + (size_t)y * columns;
        for (int x = 1; x < columns - 1; x++) to[x] = scale * (here[x + 1] + here[x - 1] + below[x] + above[x] - 4.0f * here[x]);
        for (int x = 0; x < columns; x += columns > 1 ? columns - 1 : 1)
            to[x] = scale * (here[least(x + 1, columns - 1)] + here[x ? x - 1 : 0] + below[x] + above[x] - 4.0f * here[x]);
    }
}

static WIDE void less_decayed(const float *restrict depth, float decay, size_t n, float *restrict curvature) {
    for (size_t k = 0; k < n; k++) curvature[k] = depth[k] - decay * curvature[k];
}

/* L^2: the unit's, or as short as hollow skin shows, rounded down to one of `contact_steps`. weights: as many floats. */
static float find_decay(const Plan *plan, const float *depth, const float *curvature, float deepest, int rows, int columns, float *weights) {
    const int step = (int)plan->contact_step, steps = (int)plan->contact_steps;
    const float pull = (float)plan->pull * deepest, deep = (float)plan->least_deep * deepest, kink = (float)plan->contact_kink;
    const float longest = (float)(plan->contact_decay * plan->contact_decay), per = (float)steps / longest;
    if (!plan->contact_by_frame) return longest;
    double total = 0.0, below = 0.0;
    memset(weights, 0, sizeof(float) * ((size_t)steps + 1));
    for (int y = step / 2; y < rows; y += step)
        for (int x = step / 2; x < columns; x += step) {
            const size_t at = (size_t)y * columns + x;
            if (!(curvature[at] > 0.0f) || !(depth[at] > deep)) continue;
            const float decay = per * ((depth[at] + pull) / curvature[at] - kink);
            weights[decay < 0.0f ? 0 : decay < (float)steps ? (int)decay : steps] += curvature[at], total += curvature[at];
        }
    int found = 0;
    while (found < steps && (below += weights[found]) < plan->pulling * total) found++;
    return (float)found / per;
}

/* The frame's pressure: a quantile of the deep skin's. some: as many floats as two times the samples. */
static float frame_pressure(const Plan *plan, const float *depth, const float *pressure, float deepest, int rows, int columns, float *some) {
    const int step = (int)plan->contact_step;
    const float deep = (float)plan->deep * deepest;
    int n = 0;
    for (int y = step / 2; y < rows; y += step)
        for (int x = step / 2; x < columns; x += step) {
            const size_t at = (size_t)y * columns + x;
            if (depth[at] > deep) some[n++] = pressure[at];
        }
    const int below = (int)ceilf((float)plan->large * (float)n) - 1;
    return n ? sorted(some, some + n, n)[below < 0 ? 0 : below < n ? below : n - 1] : 0.0f;
}

/* Sums of 2 `reach` + 1 lines each `step` floats behind the last. */
static WIDE void sum_lines(const float *first, size_t step, int reach, int n, float *restrict sums) {
    memcpy(sums, first, sizeof(float) * (size_t)n);
    int k = 1;
    for (; k + 3 <= 2 * reach; k += 4) {
        const float *a = first + (size_t)k * step, *b = a + step, *c = b + step, *d = c + step;
        for (int x = 0; x < n; x++) sums[x] += (a[x] + b[x]) + (c[x] + d[x]);
    }
    for (; k <= 2 * reach; k++)
        for (int x = 0; x < n; x++) sums[x] += first[(size_t)k * step + x];
}

/* Mean over `reach` pixels either way of an image (rows, columns) with `reach` rows of zeros above and below it. line: columns + 2 reach floats. */
static void box_mean(const float *image, int rows, int columns, int reach, float *line, float *means) {
    const float per = 1.0f / (float)((2 * reach + 1) * (2 * reach + 1));
    memset(line, 0, sizeof(float) * (size_t)(columns + 2 * reach));
    for (int y = 0; y < rows; y++, means += columns) {
        sum_lines(image + (size_t)y * columns, (size_t)columns, reach, columns, line + reach);
        sum_lines(line, 1, reach, columns, means);
        for (int x = 0; x < columns; x++) means[x] *= per;
    }
}

static WIDE void find_touching(const float *restrict pressure, float needed, size_t n, float *restrict touching) {
    for (size_t k = 0; k < n; k++) touching[k] = pressure[k] > needed ? 1.0f : 0.0f;
}

static WIDE void less_needed(const float *restrict inside, const float *restrict mean, float needed, float fall, size_t n, float *restrict pressure) {
    for (size_t k = 0; k < n; k++) {
        const float rim = fall * (inside[k] / (mean[k] > 1e-9f ? mean[k] : 1e-9f));
        pressure[k] -= rim > needed ? rim : needed;
    }
}

/* ContactFromDepth.above(): from blurred depth and its curvature, pressure less what contact needs in place of the curvature.
 * some: 3 images, 2 reach rows and one and reach values more. */
static void above(const Plan *plan, const float *depth, float *pressure, int rows, int columns, float *some) {
    const int n = rows * columns, reach = (int)plan->rim_reach;
    const float deepest = largest(depth, (size_t)n, 0), decay = find_decay(plan, depth, pressure, deepest, rows, columns, some);
    const float longest = (float)(plan->contact_decay * plan->contact_decay), soft = decay / (longest > 1e-9f ? longest : 1e-9f);
    less_decayed(depth, decay, (size_t)n, pressure);
    const float large = frame_pressure(plan, depth, pressure, deepest, rows, columns, some);
    const float by_share = soft * (float)plan->share * large, by_depth = (float)plan->least_depth * deepest;
    const float needed = by_share > by_depth ? by_share : by_depth, fall = soft * (float)plan->fall;
    const size_t border = (size_t)reach * columns;
    float *touching = some + border, *mean = touching + n + border, *inside = mean + n, *line = inside + n;
    memset(some, 0, sizeof(float) * border), memset(touching + n, 0, sizeof(float) * border);
    find_touching(pressure, needed, (size_t)n, touching);
    box_mean(some, rows, columns, reach, line, mean);
    for (int k = 0; k < n; k++) touching[k] *= pressure[k];
    box_mean(some, rows, columns, reach, line, inside);
    less_needed(inside, mean, needed, fall, (size_t)n, pressure);
}

static WIDE void mark(const uint8_t *restrict deformed, const float *restrict found, size_t n, uint8_t *restrict contact) {
    for (size_t k = 0; k < n; k++) contact[k] = deformed[k] & (uint8_t)(found[k] > 0.0f);
}

int find_contact(const Plan *plan, Scratch *scratch, const float *depth, const uint8_t *deformed, uint8_t *contact) {
    const int height = (int)plan->height, width = (int)plan->width, cell = (int)plan->contact_cell, reach = (int)plan->rim_reach;
    const int rows = height / cell, columns = width / cell;
    const size_t n = (size_t)rows * columns, pixels = (size_t)height * width;
    const size_t before = scratch->used;
    float *pressure = lend(scratch, sizeof(float) * (6 * n + 2 * (size_t)reach * (columns + 1) + (size_t)columns + (size_t)width + cell + pixels));
    if (!pressure) return NO_MEMORY;
    float *blurred = pressure + n, *cells = blurred + n, *some = cells + n, *image = some + 3 * n + 2 * (size_t)reach * (columns + 1) + columns;
    if (cell > 1) cell_means(depth, width, cell, rows, columns, image, cells), depth = cells;
    const int code = blur_plane(scratch, depth, plan->contact_blur, (int)plan->contact_taps, rows, columns, blurred);
    if (code == DONE) {
        curvature_of(blurred, (float)plan->curvature_scale, rows, columns, pressure);
        above(plan, blurred, pressure, rows, columns, some);
        if (cell > 1) to_pixels(pressure, rows, columns, cell, height, width, some, image);
        mark(deformed, cell > 1 ? image : pressure, pixels, contact);
    }
    give_back(scratch, before);
    return code;
}

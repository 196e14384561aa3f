/* Depth that is zero on undeformed skin: the same results as torchvts/integration/background.py, which explains them. */
#include "kernels.h"

#include <math.h>

#define MOST_GRIDS 24

/* One grid: rows x columns cells; share on which the value is known, the value, the weight, and what was found. */
typedef struct {
    int rows, columns;
    float *share, *value, *weight, *found;
} Grid;

/* The value at a pixel of a grid that is `scale` times finer, between the middles of cells. */
static float between(const Grid *grid, const float *found, int y, int x, float scale) {
    float at_y = ((float)y + 0.5f) / scale - 0.5f, at_x = ((float)x + 0.5f) / scale - 0.5f;
    if (at_y < 0.0f) at_y = 0.0f;
    if (at_x < 0.0f) at_x = 0.0f;
    const int top = least((int)at_y, grid->rows - 1), left = least((int)at_x, grid->columns - 1);
    const int bottom = least(top + 1, grid->rows - 1), right = least(left + 1, grid->columns - 1);
    const float down = at_y - (float)top, along = at_x - (float)left;
    const float *upper = found + (size_t)top * grid->columns, *lower = found + (size_t)bottom * grid->columns;
    return (1.0f - down) * ((1.0f - along) * upper[left] + along * upper[right]) +
           down * ((1.0f - along) * lower[left] + along * lower[right]);
}

/* Means over 2 x 2 cells; beyond the border nothing is known. */
static void coarser(const Grid *fine, Grid *grid) {
    for (int y = 0; y < grid->rows; y++)
        for (int x = 0; x < grid->columns; x++) {
            float share = 0.0f, value = 0.0f, weight = 0.0f;
            for (int i = 2 * y; i < least(2 * y + 2, fine->rows); i++)
                for (int j = 2 * x; j < least(2 * x + 2, fine->columns); j++) {
                    const size_t at = (size_t)i * fine->columns + j;
                    share += fine->share[at], value += fine->value[at], weight += fine->weight[at];
                }
            const size_t here = (size_t)y * grid->columns + x;
            grid->share[here] = 0.25f * share, grid->value[here] = 0.25f * value, grid->weight[here] = 0.25f * weight;
        }
}

/* Unknown cells become the weighted mean of the nine around them, `sweeps` times; scratch holds twice the cells of the grid. */
static void relax(Grid *grid, int sweeps, float *scratch) {
    const int rows = grid->rows, columns = grid->columns;
    const size_t cells = (size_t)rows * columns;
    float *product = scratch, *next = scratch + cells;
    for (int sweep = 0; sweep < sweeps; sweep++) {
        for (size_t k = 0; k < cells; k++) product[k] = grid->weight[k] * grid->found[k];
        for (int y = 0; y < rows; y++)
            for (int x = 0; x < columns; x++) {
                const size_t here = (size_t)y * columns + x;
                next[here] = grid->found[here];
                if (grid->share[here] > 0.0f) continue;
                float sum = 0.0f, total = 0.0f;
                for (int i = y > 0 ? y - 1 : 0; i < least(y + 2, rows); i++)
                    for (int j = x > 0 ? x - 1 : 0; j < least(x + 2, columns); j++) {
                        sum += product[(size_t)i * columns + j];
                        total += grid->weight[(size_t)i * columns + j];
                    }
                total /= 9.0f;
                next[here] = sum / 9.0f / (total > 1e-9f ? total : 1e-9f);
            }
        memcpy(grid->found, next, cells * sizeof(float));
    }
}

/* Fills grids[0].found from its known cells, by way of the coarser grids. */
static void continued(Grid *grids, int count, int sweeps, float *scratch) {
    for (int k = 1; k < count; k++) coarser(&grids[k - 1], &grids[k]);
    for (int k = count - 1; k >= 0; k--) {
        Grid *grid = &grids[k];
        const size_t cells = (size_t)grid->rows * grid->columns;
        if (k == count - 1) {
            float share = 0.0f, value = 0.0f;
            for (size_t c = 0; c < cells; c++) share += grid->share[c], value += grid->value[c];
            for (size_t c = 0; c < cells; c++) grid->found[c] = value / (share > 1e-9f ? share : 1e-9f);
        } else {
            for (int y = 0; y < grid->rows; y++)
                for (int x = 0; x < grid->columns; x++)
                    grid->found[(size_t)y * grid->columns + x] = between(&grids[k + 1], grids[k + 1].found, y, x, 2.0f);
        }
        for (size_t c = 0; c < cells; c++)
            if (grid->share[c] > 0.0f) grid->found[c] = grid->value[c] / (grid->share[c] > 1e-9f ? grid->share[c] : 1e-9f);
        relax(grid, sweeps, scratch);
    }
}

/* 1 at pixels within two of which none is deformed, else 0. scratch: as large as an image. */
static void not_beside(const uint8_t *deformed, int height, int width, uint8_t *scratch, uint8_t *flat) {
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            uint8_t any = 0;
            for (int j = x > 1 ? x - 2 : 0; j < least(x + 3, width); j++) any |= deformed[(size_t)y * width + j];
            scratch[(size_t)y * width + x] = any;
        }
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            uint8_t any = 0;
            for (int i = y > 1 ? y - 2 : 0; i < least(y + 3, height); i++) any |= scratch[(size_t)i * width + x];
            flat[(size_t)y * width + x] = !any;
        }
}

/*
 * depth (frames, height, width) with what slopes leave beside a contact taken out, to out. deformed: bytes. Returns 1 where memory is
 * short.
 */
EXPORT int zero_background(const float *depth, const uint8_t *deformed, int frames, int height, int width, float stiff, float tolerance,
                           int sweeps, float *out) {
    const int cell = least(height, width) / 60 > 1 ? least(height, width) / 60 : 1;
    const size_t pixels = (size_t)height * width;
    Grid grids[MOST_GRIDS];
    int count = 0, rows = (height + cell - 1) / cell, columns = (width + cell - 1) / cell;
    size_t cells = 0;
    for (; count < MOST_GRIDS; rows = (rows + 1) / 2, columns = (columns + 1) / 2) {
        grids[count].rows = rows, grids[count].columns = columns;
        cells += (size_t)rows * columns;
        count++;
        if (least(rows, columns) <= 2) break;
    }
    const size_t first = (size_t)grids[0].rows * grids[0].columns;
    float *memory = malloc((4 * cells + 2 * first) * sizeof(float)), *scratch = memory + 4 * cells;
    uint8_t *bytes = malloc(2 * pixels), *free_skin = bytes + pixels;
    if (!memory || !bytes) {
        free(memory), free(bytes);
        return 1;
    }
    float *place = memory;
    for (int k = 0; k < count; k++) {
        const size_t size = (size_t)grids[k].rows * grids[k].columns;
        grids[k].share = place, grids[k].value = place + size, grids[k].weight = place + 2 * size, grids[k].found = place + 3 * size;
        place += 4 * size;
    }
    const float per_cell = 1.0f / (float)(cell * cell);
    for (int b = 0; b < frames; b++, depth += pixels, deformed += pixels, out += pixels) {
        not_beside(deformed, height, width, bytes, free_skin);
        float low = depth[0], high = depth[0];
        for (size_t k = 1; k < pixels; k++) {
            low = depth[k] < low ? depth[k] : low;
            high = depth[k] > high ? depth[k] : high;
        }
        const float middle = 0.5f * (low + high);
        double sum = 0.0;
        size_t flat = 0;
        for (size_t k = 0; k < pixels; k++)
            if (free_skin[k]) {
                if (depth[k] < middle) sum += depth[k], flat++;
                else free_skin[k] = 2; /* a face of the object */
            }
        const float level = flat ? (float)(sum / (double)flat) : 0.0f;
        const float range = high - level > 1e-9f ? high - level : 1e-9f;
        for (int pass = 0; pass < 2; pass++) {
            memset(grids[0].share, 0, (pass ? 2 : 3) * first * sizeof(float));
            for (int y = 0; y < height; y++)
                for (int x = 0; x < width; x++) {
                    const size_t k = (size_t)y * width + x, here = (size_t)(y / cell) * grids[0].columns + x / cell;
                    const int known = free_skin[k] != 0;
                    if (known) {
                        grids[0].share[here] += per_cell;
                        grids[0].value[here] += per_cell * (free_skin[k] == 2 ? level : depth[k]);
                    } else if (pass && depth[k] < out[k] - tolerance * range) { /* below zero: that too is an error */
                        grids[0].share[here] += per_cell;
                        grids[0].value[here] += per_cell * depth[k];
                    }
                    if (!pass) {
                        const float above = depth[k] > level ? (depth[k] - level) / range : 0.0f;
                        grids[0].weight[here] += per_cell * (1.0f + stiff * above * above);
                    }
                }
            continued(grids, count, sweeps, scratch);
            for (int y = 0; y < height; y++)
                for (int x = 0; x < width; x++) {
                    const size_t k = (size_t)y * width + x;
                    out[k] = cell > 1 ? between(&grids[0], grids[0].found, y, x, (float)cell) : grids[0].found[k];
                }
        }
        for (size_t k = 0; k < pixels; k++) out[k] = free_skin[k] == 1 ? 0.0f : depth[k] - out[k];
    }
    free(memory), free(bytes);
    return 0;
}

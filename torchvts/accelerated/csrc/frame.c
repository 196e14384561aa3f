/* A whole frame in one call: what DepthPipeline.depth_of() in torchvts/pipeline/depth.py does block by block. */
#include "kernels.h"

/* The settings and tables of a pipeline's blocks, in the order of a frame's way; torchvts/accelerated/frame.py has the same. */
typedef struct {
    int32_t height, width;
    /* Compensate */
    int32_t taps;
    const float *gain, *offset, *weights;
    const int64_t *defect, *neighbours;
    int64_t defects;
    float pedestal[3];
    int32_t drifts, drift_stride, halvings;
    float least_drift, most_drift;
    /* ContactMask */
    int32_t step, stride, cell, reach, bridge;
    float sigmas, rounding, least_cells, bridge_sigmas;
    const float *flat, *per_noise, *failed_below, *most_far_field;
    /* Crop: corners on multiples of `corners` */
    int32_t corners;
    /* NormalFromResponse; or, where `inverse` is given, NormalFromIntensity */
    int32_t degree, terms;
    const float *place, *weight, *per_mm, *dark, *saturated, *inverse;
    float max_sine;
    /* GradientFromNormal and PoissonBackground */
    float per_slope, pitch, half_per_mm;
    const double *tables;
    int32_t passes;
    /* ZeroBackground; after ContactFromDepth, SlopesOfDepth */
    int32_t zeroes, sweeps, slopes_of_depth;
    float stiff, tolerance;
    /* ContactFromDepth */
    int32_t contact_cell, contact_reach;
    float contact_model[9];
} Program;

/* DepthOutput, of one frame. */
typedef struct {
    float *depth, *gradient, *normal;
    uint8_t *contact, *deformed;
} Output;

/* Memory of one frame besides. */
typedef struct {
    float *light, *normal, *gradient, *slopes, *depth;
    uint8_t *inner, *contact;
} Work;

typedef struct {
    int top, left, rows, columns;
} Window;

/* What solve_frames() returns, a bit each: memory is short; the image is not in [0, 1]; a value that is not finite, or a light that is blocked,
   which the blocks know about. */
enum { SHORT = 1, OUTSIDE = 2, BEYOND = 4 };

/* The compensated image; null, and a bit in `trouble`, where there is none. */
static const float *compensated(const Program *of, const float *image, float *light, int *trouble) {
    const int height = of->height, width = of->width;
    const int code = clean(image, of->gain, of->offset, of->pedestal, of->defect, of->neighbours, of->defects, of->weights, of->taps, 1, height,
                           width, light);
    float level[3] = {1.0f, 1.0f, 1.0f};
    *trouble |= code;
    if (code) return NULL;
    if (of->drifts && levels(light, 1, height, width, of->drift_stride, of->halvings, of->least_drift, of->most_drift, level)) *trouble |= SHORT;
    if (level[0] != 1.0f || level[1] != 1.0f || level[2] != 1.0f) divide_planes(light, level, 3, (int64_t)height * width, light);
    return light;
}

/* Crop.window() of torchvts/core/frame.py. */
static Window window_of(const Program *of, const uint8_t *deformed) {
    const int height = of->height, width = of->width, side = of->corners;
    int box[4];
    box_of(deformed, 1, height, width, box);
    int top = (box[0] > 0 ? box[0] - 1 : 0) / side * side, left = (box[2] > 0 ? box[2] - 1 : 0) / side * side;
    int bottom = (box[1] + side) / side, right = (box[3] + side) / side;
    bottom = least(height, (bottom > top / side + 2 ? bottom : top / side + 2) * side);
    right = least(width, (right > left / side + 2 ? right : left / side + 2) * side);
    top = least(top, bottom - 2 * side), left = least(left, right - 2 * side);
    top = top > 0 ? top : 0, left = left > 0 ? left : 0;
    if ((double)(bottom - top) * (right - left) > 0.8 * height * width || top % side || left % side) top = left = 0, bottom = height, right = width;
    const Window window = {top, left, bottom - top, right - left};
    return window;
}

/* One pass: normals, gradient and depth. depth: in the window, of the pass before, or null. Returns the bits of solve_frames(). */
static int solve(const Program *of, const float *light, const uint8_t *deformed, const float *before, Window at, Work work, float *depth) {
    const int width = of->width, n = at.rows * at.columns;
    const int64_t pixels = (int64_t)of->height * width, corner = (int64_t)at.top * width + at.left;
    if (of->inverse) {
        if (normals(light + corner, 0, pixels, width, of->dark + corner, of->saturated + corner, of->inverse + corner, pixels, width, 1, at.rows,
                    at.columns, NULL, 0, 0, NULL, NULL, 0.0f, 0.0f, 0.0f, 0.0f, work.normal))
            return BEYOND;
    } else {
        response_normals(light + corner, 0, pixels, width, of->place + at.left, of->weight + (size_t)2 * of->terms * (of->degree + 1) * at.top,
                         of->degree, of->terms, before ? before + corner : NULL, 0, width, before ? of->per_mm + 9 * at.top : NULL, of->max_sine, 1,
                         at.rows, at.columns, work.normal);
    }
    slopes(work.normal, 1, n, of->per_slope, work.slopes);
    mask_values(work.slopes, deformed + corner, 0, width, 1, 2, at.rows, at.columns, work.gradient);
    return solve_poisson(work.gradient, of->tables, of->pitch, 1, at.rows, at.columns, at.top, at.left, of->height, width, 1, depth);
}

static int solve_frame(const Program *of, const float *image, Work work, Output out) {
    const int height = of->height, width = of->width;
    int trouble = 0;
    const float *light = compensated(of, image, work.light, &trouble);
    if (trouble) return trouble;
    const int code = contact_mask(light, of->flat, of->per_noise, of->failed_below, of->most_far_field, 1, height, width, of->step, of->stride,
                                  of->cell, of->reach, of->sigmas, of->rounding, of->least_cells, of->bridge, of->bridge_sigmas, out.deformed,
                                  work.inner);
    if (code) return code == 1 ? SHORT : BEYOND;
    Window at = window_of(of, out.deformed);
    float *found = of->zeroes ? work.depth : out.depth;
    for (int pass = 0; pass < of->passes && !trouble; pass++) {
        trouble = solve(of, light, out.deformed, pass ? found : NULL, at, work, found);
        if (pass || trouble || !add_cut_faces(found, out.deformed, height, width, work.normal)) continue;
        at = window_of(of, out.deformed);
        trouble = solve(of, light, out.deformed, NULL, at, work, found);
    }
    if (trouble) return trouble;
    const size_t corner = (size_t)at.top * width + at.left;
    if (of->zeroes && zero_background(found, out.deformed, 1, height, width, of->stiff, of->tolerance, of->sweeps, out.depth)) return SHORT;
    if (contact_from_depth(out.depth + corner, 0, width, work.gradient, out.deformed + corner, 0, width, 1, at.rows, at.columns, of->contact_cell,
                           of->contact_reach, of->contact_model, work.contact))
        return SHORT;
    if (of->slopes_of_depth)
        depth_slopes(out.depth + corner, 0, width, out.deformed + corner, 0, width, of->half_per_mm, 1, at.rows, at.columns, work.gradient);
    uncrop(work.gradient, work.contact, 1, at.rows, at.columns, at.top, at.left, height, width, out.gradient, out.normal, out.contact);
    return 0;
}

/*
 * images (frames, 3, height, width) to depth (frames, height, width), gradient (frames, 2, ...), normal (frames, 3, ...), contact and deformed
 * (frames, ...) bytes, each frame by itself. Returns 0, or bits that say what stopped a frame; the output then means nothing.
 */
EXPORT int solve_frames(const Program *of, const float *images, int frames, float *depth, float *gradient, float *normal, uint8_t *contact,
                        uint8_t *deformed) {
    const size_t pixels = (size_t)of->height * of->width;
    float *floats = malloc(pixels * (11 * sizeof(float) + 2));
    if (!floats) return SHORT;
    const Work work = {floats,
                       floats + 3 * pixels,
                       floats + 6 * pixels,
                       floats + 8 * pixels,
                       floats + 10 * pixels,
                       (uint8_t *)(floats + 11 * pixels),
                       (uint8_t *)(floats + 11 * pixels) + pixels};
    int trouble = 0;
    for (size_t b = 0; b < (size_t)frames && !trouble; b++) {
        const Output out = {depth + b * pixels, gradient + 2 * b * pixels, normal + 3 * b * pixels, contact + b * pixels, deformed + b * pixels};
        trouble = solve_frame(of, images + 3 * b * pixels, work, out);
    }
    free(floats);
    return trouble;
}

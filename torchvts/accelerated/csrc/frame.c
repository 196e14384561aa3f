/* A whole frame in one call: what DepthPipeline.depth_of() in torchvts/pipeline/depth.py does block by block. */
#include "kernels.h"

#include <math.h>

/* Place of the model's `most_tail` in contact_model: see Model of touching.c. */
enum { MOST_TAIL = 5 };

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
    float least_drift, most_drift, believed_drift;
    /* ContactMask */
    int32_t step, stride, cell, reach, bridge;
    float sigmas, rounding, least_cells, bridge_sigmas, tail_sigmas, least_spread, least_colour;
    const SmoothLight *smooth; /* of SmoothDrift too; or null */
    const float *flat, *per_noise, *failed_below, *most_far_field;
    /* Crop: corners on multiples of `corners` */
    int32_t corners;
    /* NormalFromResponse; or, where `inverse` is given, NormalFromIntensity */
    int32_t degree, terms;
    const float *place, *weight, *per_mm, *noise, *lit, *saturated, *inverse;
    float max_sine, steeper, reference_mm;
    /* GradientFromNormal and PoissonBackground */
    float per_slope, pitch, half_per_mm;
    const double *tables;
    int32_t passes;
    /* ZeroBackground; after ContactFromDepth, SlopesOfDepth */
    int32_t zeroes, sweeps, slopes_of_depth;
    float stiff, tolerance;
    /* ContactFromDepth */
    int32_t contact_cell, contact_reach;
    float contact_model[13];
} Program;

/* DepthOutput, of one frame. */
typedef struct {
    float *depth, *gradient, *normal;
    uint8_t *contact, *deformed;
} Output;

/* Memory of one frame besides. */
typedef struct {
    float *light, *gradient, *depth;
    uint8_t *tail, *inner, *line; /* two lines, and four bytes each, behind `inner` */
} Work;

typedef struct {
    int top, left, rows, columns;
} Window;

/* What solve_frames() returns, a bit each: memory is short; the image is not in [0, 1]; a value that is not finite, or a light that is blocked,
   which the blocks know about. */
enum { SHORT = 1, OUTSIDE = 2, BEYOND = 4 };

/* The first stage of a frame, which compensated() finishes. */
typedef struct {
    Cleaning work;
    Leveling leveling;
    float level[3];
} Compensation;

static void prepare_compensation(Compensation *at, const Program *of, const float *image, float *light) {
    at->leveling = (Leveling){of->drift_stride, of->halvings, of->least_drift, of->most_drift};
    for (int c = 0; c < 3; c++) at->level[c] = 1.0f;
    prepare_cleaning(&at->work, image, of->gain, of->offset, of->pedestal, of->defect, of->neighbours, of->defects, of->weights, of->taps, of->height,
                     of->width, light, of->drifts ? &at->leveling : NULL, at->level);
}

/* The compensated image, of which all parts are done; null, and a bit in `trouble`, where there is none. */
static const float *compensated(const Program *of, Compensation *at, int *trouble) {
    float *light = at->work.light, *level = at->level;
    *trouble |= cleaned(&at->work);
    if (*trouble) return NULL;
    for (int c = 0; c < 3; c++)
        if (!(fabsf(level[c] - 1.0f) < of->believed_drift)) *trouble |= BEYOND; /* another estimator takes over */
    if (*trouble) return NULL;
    if (level[0] != 1.0f || level[1] != 1.0f || level[2] != 1.0f) divide_planes(light, level, 3, (int64_t)of->height * of->width, light);
    return light;
}

/* Crop.window() of torchvts/core/frame.py; without any row where no skin has moved. */
static Window window_of(const Program *of, const uint8_t *deformed) {
    const int height = of->height, width = of->width, side = of->corners;
    int box[4];
    box_of(deformed, 1, height, width, box);
    if (box[1] == 0) return (Window){0, 0, 0, 0};
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

/* One pass over the window at hand. surface: the smooth change of the light; before: depth of the pass before, or null. */
typedef struct {
    const Program *of;
    const float *light, *surface, *before;
    const uint8_t *deformed;
    Window at;
    float *gradient, three_noises[3];
    atomic_int trouble;
} Pass;

/* Normals and gradient of so many rows at once: few, so that what lies between stays at hand. */
enum { ROWS = 8 };

static void rows_of_gradient(void *with, int part) {
    Pass *pass = with;
    const Program *of = pass->of;
    const Window at = pass->at;
    const int first = part * ROWS, rows = least(ROWS, at.rows - first), columns = at.columns, width = of->width;
    const int64_t plane = (int64_t)of->height * width, n = (int64_t)rows * columns, corner = (int64_t)(at.top + first) * width + at.left;
    const float *light = pass->light + corner, *before = pass->before ? pass->before + corner : NULL;
    float *normal = malloc(sizeof(float) * 8 * (size_t)n), *gradient = normal + 3 * n, *to = pass->gradient + (int64_t)first * columns;
    if (!normal) {
        atomic_fetch_or(&pass->trouble, SHORT);
        return;
    }
    int64_t per_channel = plane, per_row = width;
    if (of->smooth) {
        float *rest = gradient + 2 * n;
        for (int k = 0; k < 3 * rows; k++)
            row_over_smooth(of->smooth, pass->surface + 6 * (k / rows), at.top + first + k % rows, at.left, columns,
                            light + plane * (k / rows) + (int64_t)width * (k % rows), rest + (int64_t)columns * k);
        light = rest, per_channel = n, per_row = columns;
    }
    if (of->inverse) {
        if (normals(light, 0, per_channel, per_row, pass->three_noises, of->lit + corner, of->saturated + corner, of->inverse + corner, plane, width, 1, rows,
                    columns, NULL, 0, 0, NULL, NULL, 0.0f, 0.0f, 0.0f, 0.0f, normal))
            atomic_fetch_or(&pass->trouble, BEYOND);
    } else {
        const float *weight = of->weight + (size_t)2 * of->terms * (of->degree + 1) * (at.top + first);
        response_normals(light, 0, per_channel, per_row, of->place + at.left, weight, of->degree, of->terms, before, 0, width,
                         before ? of->per_mm + 9 * (at.top + first) : NULL, of->steeper, of->reference_mm, of->max_sine, 1, rows, columns, normal);
    }
    slopes(normal, 1, (int)n, of->per_slope, gradient);
    for (int c = 0; c < 2; c++)
        mask_values(gradient + n * c, pass->deformed + corner, 0, width, 1, 1, rows, columns, to + (int64_t)at.rows * columns * c);
    free(normal);
}

/* Gradient and depth. Returns the bits of solve_frames(). */
static int solve(const Program *of, const float *light, const float *surface, const uint8_t *deformed, const float *before, Window at, Work work, float *depth) {
    Pass pass = {.of = of, .light = light, .surface = surface, .before = before, .deformed = deformed, .at = at, .gradient = work.gradient};
    for (int c = 0; c < 3 && of->inverse; c++) pass.three_noises[c] = 3.0f * of->noise[c];
    share(rows_of_gradient, &pass, (at.rows + ROWS - 1) / ROWS);
    if (pass.trouble) return pass.trouble;
    return solve_poisson(work.gradient, of->tables, of->pitch, 1, at.rows, at.columns, at.top, at.left, of->height, of->width, 1, depth);
}

/* Gradient, normals and slopes of depth, while contact is found. */
typedef struct {
    Slopes slopes;
    Uncropping uncropping;
    int slopes_of_depth, bands;
} RestOfOutput;

static void rows_of_output(void *with, int band) {
    const RestOfOutput *of = with;
    const Uncropping *to = &of->uncropping;
    const int first = to->height * band / of->bands, last = to->height * (band + 1) / of->bands;
    const int top = first > to->top ? first - to->top : 0, bottom = least(last - to->top, to->rows);
    if (of->slopes_of_depth) rows_of_slopes(&of->slopes, top, bottom);
    rows_uncropped(to, first, last);
}

/* Contact of the window, and the rest of the output. Returns the bits of solve_frames(). */
static int finish(const Program *of, Window at, Work work, Output out) {
    const int width = of->width;
    const size_t corner = (size_t)at.top * width + at.left;
    RestOfOutput rest = {{out.depth + corner, width, out.deformed + corner, width, of->half_per_mm, at.rows, at.columns, work.gradient},
                     {work.gradient, NULL, at.rows, at.columns, at.top, at.left, of->height, width, out.gradient, out.normal, out.contact},
                     of->slopes_of_depth,
                     bands_of(of->height)};
    Touching touching = {.depth = out.depth + corner, .depth_row = width, .gradient = work.gradient, .deformed = out.deformed + corner};
    touching.rows = at.rows, touching.columns = at.columns, touching.cell = of->contact_cell, touching.reach = of->contact_reach;
    touching.numbers = of->contact_model, touching.edge = NO_EDGE, touching.deformed_row = touching.contact_row = width;
    touching.contact = out.contact + corner, touching.beside = rows_of_output, touching.with = &rest, touching.parts = rest.bands;
    if (above_tail(out.depth + corner, out.deformed + corner, work.tail + corner, width, at.rows, at.columns, of->contact_model[MOST_TAIL],
                   work.inner + corner, work.line, &touching.edge))
        touching.deformed = work.inner + corner;
    return find_contact(&touching) ? SHORT : 0;
}

/* compensation: its parts are done. */
static int solve_frame(const Program *of, Compensation *compensation, Work work, Output out) {
    const int height = of->height, width = of->width;
    int trouble = 0;
    const float *light = compensated(of, compensation, &trouble);
    if (trouble) return trouble;
    float surface[18];
    const int code = contact_mask(light, light, of->flat, of->per_noise, of->failed_below, of->most_far_field, 1, height, width, of->step, of->stride,
                                  of->cell, of->reach, of->sigmas, of->rounding, of->least_cells, of->bridge, of->bridge_sigmas, of->tail_sigmas,
                                  of->least_spread, of->least_colour, of->smooth, surface, out.deformed, work.inner, work.tail);
    if (code) return code == 1 ? SHORT : BEYOND;
    Window at = window_of(of, out.deformed);
    if (at.rows == 0) {
        memset(out.depth, 0, sizeof(float) * (size_t)height * width);
        uncrop(NULL, NULL, 1, 0, 0, 0, 0, height, width, out.gradient, out.normal, out.contact);
        return 0;
    }
    float *found = of->zeroes ? work.depth : out.depth, ends[2];
    int same = 0; /* whether `ends` are still those of the depth found */
    for (int pass = 0; pass < of->passes && !trouble; pass++) {
        trouble = solve(of, light, surface, out.deformed, pass ? found : NULL, at, work, found);
        same = !pass && !trouble && !add_faces(found, out.deformed, height, width, work.inner, ends);
        if (pass || trouble || same) continue;
        at = window_of(of, out.deformed);
        trouble = solve(of, light, surface, out.deformed, NULL, at, work, found);
    }
    if (trouble) return trouble;
    if (of->zeroes && zero_frame(found, out.deformed, height, width, of->stiff, of->tolerance, of->sweeps, same ? ends : NULL, out.depth)) return SHORT;
    return finish(of, at, work, out);
}

/* Memory of a frame, with the compensated image in front. */
static float *memory_of(const Program *of) {
    const size_t pixels = (size_t)of->height * of->width;
    return malloc(pixels * (6 * sizeof(float) + 2) + 2 * ((size_t)of->width + 4));
}

/* A frame that this thread has begun: see begin_frame(). */
typedef struct {
    const Program *of;
    const float *image;
    float *floats;
    Compensation compensation;
} Begun;

static _Thread_local Begun *begun;

/* After begin_frame(): ends what nobody went on with. */
EXPORT void forget_frame(void) {
    if (!begun) return;
    withdraw();
    end_sharing(1);
    free(begun->floats);
    free(begun);
    begun = NULL;
}

/* Has helpers begin with an image (3, height, width) while the caller still finds out whether the program holds: until forget_frame(), image and
   program stay where they are. Then solve_frames() of the same two goes on with what they have done. */
EXPORT void begin_frame(const Program *of, const float *image, int threads) {
    forget_frame(); /* left by a call that this one interrupts */
    if (!begin_sharing(threads)) return;
    begun = malloc(sizeof *begun);
    float *floats = memory_of(of);
    if (!begun || !floats) {
        free(begun), free(floats);
        begun = NULL;
        end_sharing(1);
        return;
    }
    begun->of = of, begun->image = image, begun->floats = floats;
    prepare_compensation(&begun->compensation, of, image, floats);
    offer(clean_band, &begun->compensation.work, begun->compensation.work.parts);
}

/*
 * images (frames, 3, height, width) to depth (frames, height, width), gradient (frames, 2, ...), normal (frames, 3, ...), contact and deformed
 * (frames, ...) bytes, each frame by itself, in up to `threads` threads. Returns 0, or bits that say what stopped a frame; the output then means
 * nothing.
 */
EXPORT int solve_frames(const Program *of, const float *images, int frames, int threads, float *depth, float *gradient, float *normal,
                        uint8_t *contact, uint8_t *deformed) {
    const size_t pixels = (size_t)of->height * of->width;
    Begun *first = begun && begun->of == of && begun->image == images ? begun : NULL;
    float *floats = first ? first->floats : memory_of(of);
    if (!floats) return SHORT;
    uint8_t *bytes = (uint8_t *)(floats + 6 * pixels);
    const Work work = {floats, floats + 3 * pixels, floats + 5 * pixels, bytes, bytes + pixels, bytes + 2 * pixels};
    const int shared = first ? 1 : begin_sharing(threads);
    int trouble = 0;
    for (size_t b = 0; b < (size_t)frames && !trouble; b++) {
        const Output out = {depth + b * pixels, gradient + 2 * b * pixels, normal + 3 * b * pixels, contact + b * pixels, deformed + b * pixels};
        Compensation own, *compensation = first && b == 0 ? &first->compensation : &own;
        if (compensation != &own) {
            join_in(threads);
        } else {
            prepare_compensation(&own, of, images + 3 * b * pixels, work.light);
            share(clean_band, &own.work, own.work.parts);
        }
        trouble = solve_frame(of, compensation, work, out);
    }
    end_sharing(shared);
    if (first) {
        begun = NULL;
        free(first);
    }
    free(floats);
    return trouble;
}

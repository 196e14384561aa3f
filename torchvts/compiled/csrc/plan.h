/* A frozen pipeline: the tables and settings that the stages of a frame read, and what of them a file may hold. Python makes the file from the blocks of
   a pipeline, and takes names and kinds of the fields from plan_fields(); load.c reads it: no layout is written twice. Numbers of a formula (three
   sigmas, a ridge) stand in both. */
#ifndef TORCHVTS_PLAN_H
#define TORCHVTS_PLAN_H

#include "kernels.h"
#include "scratch.h"

/* Largest side of an image, and most pixels; most taps of a blur, and most waves, terms and steps of anything. */
enum { MOST_SIDE = 16384, MOST_PIXELS = 1 << 26, MOST_TAPS = 1025, MOST_WAVES = 48, MOST_STEPS = 100 };

/* Every field of a plan, once: INTEGER(name, least, most), REAL(name, least) of at most 1e12, TABLE(type, name, values), or OPTION(...), a table that
   may be missing. How many values a table has follows from the numbers of the plan p; no file is asked. */
#define PIXELS (p->height * p->width)
#define SAMPLES (p->relight_rows * p->relight_columns)
#define BY_LIGHTS(values) (p->by_lights ? (values) : 0)
#define BY_RESPONSE(values) (p->by_lights ? 0 : (values))
#define ROWS(cell) (p->height / p->cell)
#define COLUMNS(cell) (p->width / p->cell)
#define PAIRS(terms) (p->terms * (p->terms + 1) / 2)

#define IMAGE_FIELDS(INTEGER, REAL, TABLE, OPTION)                                                                                            \
    /* metric: 1 where lengths are mm, 0 where their scale is not known */                                                                    \
    INTEGER(height, 2, MOST_SIDE) INTEGER(width, 2, MOST_SIDE) REAL(mm_per_pixel, 1e-9) INTEGER(metric, 0, 1)                                 \
    /* markers.c; diameter in pixels, 0 for a skin without */                                                                                 \
    REAL(marker_diameter, 0) REAL(marker_contrast, 0) REAL(marker_sigmas, 0) REAL(marker_margin, 0)                                           \
    /* compensate.c; light is value^exponent; light of the values k / (lights - 1), or none; maps (3, height, width); defect (defects), neighbours (.., 4) */          \
    REAL(exponent, 1e-9) INTEGER(lights, 0, 1 << 20) TABLE(float, light_of, p->lights)                                                                             \
    OPTION(float, gain, 3 * PIXELS) TABLE(float, pedestal, 3)                                                                                 \
    INTEGER(defects, 0, MOST_PIXELS) TABLE(int64_t, defect, p->defects) TABLE(int64_t, neighbours, 4 * p->defects)                            \
    INTEGER(blur_taps, 0, MOST_TAPS) TABLE(float, blur, p->blur_taps)                                                                         \
    /* light.c; background (3, height, width), skin (3, samples), share (3, padded), place (3, 6, padded), terms (3, 6, 6), scales (steps),   \
       along_x (2, width), along_y (2, height) */                                                                                             \
    INTEGER(relights, 0, 1) INTEGER(relight_stride, 1, MOST_SIDE) INTEGER(relight_rows, 1, MOST_SIDE) INTEGER(relight_columns, 1, MOST_SIDE)  \
    INTEGER(relight_padded, 8, MOST_PIXELS) INTEGER(relight_every, 1, MOST_SIDE) INTEGER(relight_steps, 0, MOST_STEPS)                        \
    TABLE(float, background, 3 * PIXELS) TABLE(float, relight_skin, 3 * SAMPLES) TABLE(double, relight_share, 3 * p->relight_padded)          \
    TABLE(double, relight_place, 18 * p->relight_padded) TABLE(double, relight_terms, 108) TABLE(double, relight_scales, p->relight_steps)    \
    TABLE(float, along_x, 2 * p->width) TABLE(float, along_y, 2 * p->height)                                                                  \
    REAL(saturation_light, -1e12) REAL(black, 0) REAL(alike, 0) REAL(exact, 0) REAL(damping, 0) REAL(better, 0) REAL(lost, 0)                 \
    REAL(least_light, 0)

#define NORMAL_FIELDS(INTEGER, REAL, TABLE, OPTION)                                                                                           \
    /* normals.c and shadowed.c; maps (3, height, width), inverse (3, 3, height, width), position (3, 3), albedo (3) */                       \
    INTEGER(by_lights, 0, 1) TABLE(float, inverse, BY_LIGHTS(9 * PIXELS)) TABLE(float, flat_light, BY_LIGHTS(3 * PIXELS))                     \
    TABLE(float, saturated_above, BY_LIGHTS(3 * PIXELS)) TABLE(uint8_t, ill_conditioned, BY_LIGHTS(PIXELS))                                   \
    INTEGER(any_ill_conditioned, 0, 1) TABLE(float, position, BY_LIGHTS(9)) TABLE(float, albedo, BY_LIGHTS(3))                                \
    TABLE(float, noise_std, BY_LIGHTS(3)) REAL(prior_std, 0) REAL(brightness_noises, 0) REAL(least_brightness, 0)                             \
    INTEGER(shadow_steps, 0, MOST_STEPS) REAL(cliff_slope, 0) REAL(start_slope, 0) REAL(failed_share, 0)                                       \
    /* response.c; field_place (width), field (height, degree + 1, 2, terms), per_mm (height, 3, 3) */                                        \
    INTEGER(degree, 0, 6) INTEGER(terms, 0, 19) TABLE(float, field_place, BY_RESPONSE(p->width))                                              \
    TABLE(float, field, BY_RESPONSE(2 * p->height * (p->degree + 1) * p->terms)) OPTION(float, per_mm, BY_RESPONSE(9 * p->height))            \
    REAL(steeper, -1e12) REAL(reference_mm, -1e12) REAL(max_sine, 0) REAL(max_slope, 0)

#define SKIN_FIELDS(INTEGER, REAL, TABLE, OPTION)                                                                                             \
    /* weight.c; maps (3, height, width), mask_noise of cells */                                                                              \
    INTEGER(mask_cell, 1, MOST_SIDE) TABLE(float, mask_flat, 3 * PIXELS) TABLE(float, per_light, 3 * PIXELS)                                  \
    TABLE(float, mask_noise, ROWS(mask_cell) * COLUMNS(mask_cell)) INTEGER(mask_taps, 1, MOST_TAPS) TABLE(float, mask_blur, p->mask_taps)     \
    INTEGER(takes_slopes, 0, 1) INTEGER(by_colour, 0, 1) REAL(rise_from, -1e12) REAL(rise_to, -1e12) REAL(sigmas, 0) REAL(least_spread, 0)    \
    REAL(most_spread, 0) REAL(hanging, 0) REAL(rough, 0) REAL(grey_share, 0) REAL(failed_light, 0) REAL(within, 0) REAL(square_within, 0)     \
    REAL(fewest, 0)                                                                                                                           \
    /* zero.c; cosines along y (waves_y, cells) and x, their pairs of two transposed, at pixels, 1 + L^2 k^2 of each of them */               \
    INTEGER(zero_cell, 1, MOST_SIDE) INTEGER(waves_y, 1, MOST_WAVES) INTEGER(waves_x, 1, MOST_WAVES)                                          \
    TABLE(double, cosine_y, p->waves_y * ROWS(zero_cell)) TABLE(double, cosine_x, p->waves_x * COLUMNS(zero_cell))                            \
    TABLE(double, pairs_y, PAIRS(waves_y) * ROWS(zero_cell)) TABLE(double, pairs_x, PAIRS(waves_x) * COLUMNS(zero_cell))                      \
    TABLE(double, slope_pairs_y, PAIRS(waves_y) * ROWS(zero_cell)) TABLE(double, slope_pairs_x, PAIRS(waves_x) * COLUMNS(zero_cell))          \
    TABLE(float, pixel_y, p->waves_y * p->height) TABLE(float, pixel_x, p->waves_x * p->width)                                                \
    TABLE(double, by_pressure, p->waves_y * p->waves_x) REAL(zero_decay, 0) REAL(face, 1e-9)                                             \
    REAL(smooth_mm, -1e12) REAL(stiff, -1e12) REAL(pit, -1e12) REAL(pit_share, -1e12)                                                         \
    /* pressure.c */                                                                                                                          \
    REAL(moved_depth, 0) INTEGER(contact_cell, 1, MOST_SIDE) INTEGER(contact_taps, 1, MOST_TAPS) TABLE(float, contact_blur, p->contact_taps)  \
    REAL(curvature_scale, 0) INTEGER(contact_step, 1, MOST_SIDE) REAL(contact_kink, -1e12) REAL(contact_decay, 0)                             \
    INTEGER(contact_by_frame, 0, 1) INTEGER(contact_steps, 1, MOST_STEPS) REAL(pull, -1e12) REAL(pulling, -1e12) REAL(least_deep, -1e12)      \
    REAL(share, 0) REAL(large, 0) REAL(deep, -1e12) INTEGER(rim_reach, 0, MOST_TAPS) REAL(fall, -1e12) REAL(least_depth, 0)

#define SOLVE_FIELDS(INTEGER, REAL, TABLE, OPTION)                                                                                            \
    /* frame.c */                                                                                                                             \
    INTEGER(passes, 1, MOST_STEPS) INTEGER(slopes_of_depth, 0, 1)

#define ALL_FIELDS(INTEGER, REAL, TABLE, OPTION)   \
    IMAGE_FIELDS(INTEGER, REAL, TABLE, OPTION)     \
    NORMAL_FIELDS(INTEGER, REAL, TABLE, OPTION)    \
    SKIN_FIELDS(INTEGER, REAL, TABLE, OPTION)      \
    SOLVE_FIELDS(INTEGER, REAL, TABLE, OPTION)

#define INTEGER_FIELD(name, least, most) int64_t name;
#define REAL_FIELD(name, least) double name;
#define TABLE_FIELD(type, name, values) const type *name;

/* A plan in memory; the tables of poisson.c are no field: they are made of the size. */
typedef struct Plan {
    ALL_FIELDS(INTEGER_FIELD, REAL_FIELD, TABLE_FIELD, TABLE_FIELD)
    const double *poisson;
} Plan;

/* Codes that stages return. */
enum { DONE, NO_MEMORY };

/* The stages, each in the file of its name. All images are those of one frame. */
int fill_markers(const Plan *plan, Scratch *scratch, const float *image, float *filled);                         /* (3, H, W) to the same or another */
int frame_light(const Plan *plan, Scratch *scratch, const float *image, float *terms);                           /* (3, 6), and lost (3) */
void linearise(const Plan *plan, const float *image, float *light);                                             /* (3, H, W) to the same */
int compensate(const Plan *plan, Scratch *scratch, const float *image, float *terms, float *light);              /* (3, H, W) to the same */
void find_normals(const Plan *plan, const float *light, const float *depth, float *normal);                     /* depth or null */
void find_slopes(const float *normal, size_t pixels, double max_slope, float *gradient);                        /* (2, H, W) */
int weigh(const Plan *plan, Scratch *scratch, const float *light, const float *gradient, float *unseen, float *weight); /* (1); (1, H, W) */
int integrate(const Plan *plan, Scratch *scratch, const float *gradient, float *depth);
int zero_background(const Plan *plan, Scratch *scratch, const float *weight, float *depth);                      /* in place */
void find_moved(const Plan *plan, const float *weight, const float *depth, uint8_t *deformed);
int find_contact(const Plan *plan, Scratch *scratch, const float *depth, const uint8_t *deformed, uint8_t *contact);

/* frame.c: a whole frame. image (3, height, width), conditions (22), depth (1, ..), gradient (2, ..), normal (3, ..), contact and deformed (1, ..). */
int reconstruct(const Plan *plan, Scratch *scratch, const float *image, float *conditions, float *depth, float *gradient, float *normal,
                uint8_t *contact, uint8_t *deformed);
void range(const float *values, size_t n, float *ends);

/* poisson.c: bytes of its tables, 0 where the height has a prime factor that is too large; and the tables. */
size_t poisson_size(int height);
void make_poisson(int height, int width, double *tables);

/* markers.c: whether the markers of a plan are smaller than its image. */
int markers_fit(const Plan *plan);

/* Parts that several stages share. */
float noise_of(const float *image, int height, int width, float *some);                               /* background.c; some: 2 * pixels floats */
float *sorted(float *values, float *other, int n);                                                    /* compensate.c */
int blur_plane(Scratch *scratch, const float *plane, const float *weight, int taps, int height, int width, float *out); /* compensate.c */
void response_normals(const Plan *plan, const float *light, const float *depth, float *normal);       /* response.c */
void solve_shadowed(const Plan *plan, const float *light, const float *depth, float *normal);         /* shadowed.c */
void cell_means(const float *plane, int width, int cell, int rows, int columns, float *line, float *means);       /* weight.c */
void to_pixels(const float *cells, int rows, int columns, int cell, int height, int width, float *some, float *image); /* weight.c */

#endif

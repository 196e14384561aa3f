/* A frozen pipeline: the tables and settings that the stages of a frame read. Python makes it from the blocks of a pipeline, and takes names and kinds of
   the fields from plan_fields(), so that no layout is written twice. Numbers of a formula (three sigmas, a ridge) stand in both. Tables are float32 unless
   stated otherwise. */
#ifndef TORCHVTS_PLAN_H
#define TORCHVTS_PLAN_H

#include "kernels.h"

#define IMAGE_FIELDS(INTEGER, REAL, TABLE)                                                                                                    \
    INTEGER(height) INTEGER(width) REAL(mm_per_pixel)                                                                                         \
    /* compensate.c; light of the values k / (lights - 1), or null; maps (3, height, width) or null; defect (defects), neighbours (.., 4) */  \
    TABLE(float, light_of) INTEGER(lights)                                                                                                    \
    TABLE(float, gain) TABLE(float, offset) TABLE(float, pedestal)                                                                            \
    TABLE(int64_t, defect) TABLE(int64_t, neighbours) INTEGER(defects) TABLE(float, blur) INTEGER(blur_taps)                                  \
    /* light.c; background (3, height, width), skin (3, samples), share (3, padded), place (3, 6, padded), terms (3, 6, 6), scales (steps),    \
       along_x (2, width), along_y (2, height) */                                                                                             \
    INTEGER(relights) INTEGER(relight_stride) INTEGER(relight_rows) INTEGER(relight_columns) INTEGER(relight_padded) INTEGER(relight_every)   \
    INTEGER(relight_steps) TABLE(float, background) TABLE(float, relight_skin) TABLE(double, relight_share) TABLE(double, relight_place)      \
    TABLE(double, relight_terms) TABLE(double, relight_scales) TABLE(float, along_x) TABLE(float, along_y) REAL(saturation_light) REAL(black) \
    REAL(alike) REAL(exact) REAL(damping) REAL(better) REAL(lost) REAL(least_light)

#define NORMAL_FIELDS(INTEGER, REAL, TABLE)                                                                                                   \
    /* normals.c and shadowed.c; maps (3, height, width), inverse (3, 3, height, width), position (3, 3), albedo (3) */                       \
    INTEGER(by_lights) TABLE(float, inverse) TABLE(float, flat_light) TABLE(float, saturated_above) TABLE(uint8_t, ill_conditioned)           \
    INTEGER(any_ill_conditioned) TABLE(float, position) TABLE(float, albedo) REAL(per_camera_height) TABLE(float, noise_std)                  \
    REAL(prior_std) REAL(brightness_noises) REAL(least_brightness) INTEGER(shadow_steps)        \
    REAL(cliff_slope) REAL(start_slope) REAL(left_out) REAL(failed_share)                                                                     \
    /* response.c; field_place (width), field (height, degree + 1, 2, terms), per_mm (height, 3, 3) or null */                                \
    TABLE(float, field_place) TABLE(float, field) INTEGER(degree) INTEGER(terms) TABLE(float, per_mm) REAL(steeper) REAL(reference_mm)        \
    REAL(max_sine) REAL(max_slope)

#define SKIN_FIELDS(INTEGER, REAL, TABLE)                                                                                                     \
    /* weight.c; maps (3, height, width), mask_noise of cells */                                                                              \
    INTEGER(mask_cell) TABLE(float, mask_flat) TABLE(float, per_light) TABLE(float, mask_noise) TABLE(float, mask_blur) INTEGER(mask_taps)    \
    INTEGER(takes_slopes) INTEGER(by_colour) REAL(rise_from) REAL(rise_to) REAL(sigmas) REAL(least_spread) REAL(grey_share)                   \
    REAL(failed_light) REAL(within) REAL(square_within) REAL(fewest)                                                                          \
    /* zero.c; cosines along y (waves_y, cells) and x, their pairs of two transposed, at pixels, 1 + L^2 k^2 of each of them */               \
    INTEGER(zero_cell) INTEGER(waves_y) INTEGER(waves_x) TABLE(double, cosine_y) TABLE(double, cosine_x) TABLE(double, pairs_y)               \
    TABLE(double, pairs_x) TABLE(double, slope_pairs_y) TABLE(double, slope_pairs_x) TABLE(float, pixel_y) TABLE(float, pixel_x)              \
    TABLE(double, by_pressure) REAL(zero_decay) REAL(face) REAL(smooth_mm) REAL(stiff) REAL(pit) REAL(pit_share)                              \
    /* pressure.c */                                                                                                                          \
    REAL(moved_depth) INTEGER(contact_cell) TABLE(float, contact_blur) INTEGER(contact_taps) REAL(curvature_scale) INTEGER(contact_step)      \
    REAL(contact_kink) REAL(contact_decay) INTEGER(contact_by_frame) INTEGER(contact_steps) REAL(pull) REAL(pulling) REAL(least_deep) REAL(share) REAL(large) REAL(deep) INTEGER(rim_reach) REAL(fall)\
    REAL(least_depth)

#define SOLVE_FIELDS(INTEGER, REAL, TABLE)                                                                                                    \
    /* poisson.c */                                                                                                                           \
    TABLE(double, poisson) INTEGER(zeroed)                                                                                                    \
    /* frame.c */                                                                                                                             \
    INTEGER(passes) INTEGER(slopes_of_depth)

#define ALL_FIELDS(INTEGER, REAL, TABLE)   \
    IMAGE_FIELDS(INTEGER, REAL, TABLE)     \
    NORMAL_FIELDS(INTEGER, REAL, TABLE)    \
    SKIN_FIELDS(INTEGER, REAL, TABLE)      \
    SOLVE_FIELDS(INTEGER, REAL, TABLE)

#define INTEGER_FIELD(name) int64_t name;
#define REAL_FIELD(name) double name;
#define TABLE_FIELD(type, name) const type *name;

typedef struct Plan {
    ALL_FIELDS(INTEGER_FIELD, REAL_FIELD, TABLE_FIELD)
} Plan;

/* Codes that stages return. */
enum { DONE, NO_MEMORY };

/* The stages, each in the file of its name. All images are those of one frame. */
int frame_light(const Plan *plan, const float *image, float *terms);                                            /* (3, 6), and lost (3) */
void linearise(const Plan *plan, const float *image, float *light);                                             /* (3, H, W) to the same */
int compensate(const Plan *plan, const float *image, float *terms, float *light);                               /* (3, H, W) to the same */
void find_normals(const Plan *plan, const float *light, const float *depth, float *normal);                     /* depth or null */
void find_slopes(const float *normal, size_t pixels, double max_slope, float *gradient);                        /* (2, H, W) */
int weigh(const Plan *plan, const float *light, const float *gradient, float *unseen, float *weight);           /* (1); (1, H, W) */
int integrate(const Plan *plan, const float *gradient, float *depth);
int zero_background(const Plan *plan, const float *weight, float *depth);                                       /* in place */
void find_moved(const Plan *plan, const float *weight, const float *depth, uint8_t *deformed);
int find_contact(const Plan *plan, const float *depth, const uint8_t *deformed, uint8_t *contact);

/* Parts that several stages share. */
float *sorted(float *values, float *other, int n);                                                    /* compensate.c */
int blur_plane(const float *plane, const float *weight, int taps, int height, int width, float *out); /* compensate.c */
void response_normals(const Plan *plan, const float *light, const float *depth, float *normal);       /* response.c */
void solve_shadowed(const Plan *plan, const float *light, const float *depth, float *normal);         /* shadowed.c */
void cell_means(const float *plane, int width, int cell, int rows, int columns, float *line, float *means);       /* weight.c */
void to_pixels(const float *cells, int rows, int columns, int cell, int height, int width, float *some, float *image); /* weight.c */

#endif

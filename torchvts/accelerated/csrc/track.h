/* Sums and steps of a tracked pose, which a frame passes through: see track.c. */
#ifndef TORCHVTS_TRACK_H
#define TORCHVTS_TRACK_H

#include "kernels.h"

#define SIZE 7  /* six twists and the residual */
#define SUMS 56 /* SIZE * SIZE products, then seven sums of the score: */
enum { USED = SIZE * SIZE, WEIGHT, SLOPES, HEIGHTS, BAD, GOOD, COMPARED };

/* What the residuals depend on beside the pixels; the order is that of residual_limits in inverse.py. */
typedef struct {
    double pose[16], x0, y0, pitch, per_slope, per_height, score_slope, score_height, deep, shallow;
} Limits;

/* What the steps depend on; the order is that of refine in inverse.py. */
typedef struct {
    double units[6], center[3], wide, least_noise, largest_mm, small_mm;
} Steps;

EXPORT void alignment_sums(const float *field, int height, int width, const float *columns, int64_t stride, int count, int score_only,
                           const Limits *at, double *sums);
EXPORT void part_sums(const float *field, int height, int width, const float *columns, int64_t stride, int count, int parts, const Limits *at,
                      double *sums);
EXPORT void refine_pose(const float *field, int height, int width, const float *columns, int64_t stride, int count, int steps, const Steps *by,
                        const double *held, int holds, Limits *at, double *sums);
EXPORT int height_sums(const float *field, int height, int width, const float *columns, int64_t stride, int count, const Limits *at,
                       const int64_t *cell, const double *number, const double *lines, const double *products, int cells, int modes,
                       double most_mm, double white_mm, double *left);
EXPORT int object_pixels(const float *field, int height, int width, double x0, double y0, double pitch, int64_t stride, float *columns);

/* Root mean square of slope residuals, per component. */
static inline double slope_noise_of(const double *sums) { return sqrt(0.5 * sums[SLOPES] / fmax(sums[WEIGHT], 1e-9)); }

/* Orthonormal vectors, each in a row. */
typedef struct {
    double line[6][6];
    int32_t number;
} Directions;

void both_sides(double A[6][6], double B[6][6], double to[6][6]);
double trace_of(double A[6][6], int n);
void invert_six(double A[6][6], double inverse[6][6]);
void eigen_six(double matrix[6][6], int first, int n, double values[6], double vectors[6][6]);
void add_direction(Directions *to, int n, const double *vector);
void join_directions(Directions *one, const Directions *other, int n);
void beside_directions(const Directions *all, double P[6][6]);

void solve_six(double A[6][6], const double b[6], double x[6]);
void solve_step(const double *sums, const double *held, int holds, double largest_mm, double step[6]);
void move_pose(double *pose, const double *twist, const double *center);

#endif

/* A frame registered to a keyframe where all motions are known: the same results as torchvts/pose/follow.py, which explains them. */
#include "track.h"

enum { MOST_PARTS = 16 };

/* Pixels of a keyframe: columns (23, stride). */
typedef struct {
    const float *columns;
    int64_t stride, number;
} Pixels;

/* A frame on one grid: Field of inverse.py. */
typedef struct {
    const float *field;
    int32_t height, width;
    double x0, y0, pitch;
} Grid;

/* A keyframe, and the settings of follow.py; torchvts/accelerated/following.py has the same. */
typedef struct {
    Pixels coarse, some, many;
    Grid own; /* its own coarse grid */
    const int64_t *cell;
    const double *per_cell, *lines;
    int32_t cells, modes, parts, coarse_steps, some_steps;
    double units[6], center[3];
    double per_height, score_slope, score_height, deep, shallow;                            /* of Limits */
    double slope_noise, least_noise, largest_mm, coarse_mm, small_mm;                        /* of Steps */
    double least_information, wanted[6], alike, least_slope_noise, most_height_mm, white_mm; /* what is known */
    double shared_error, unseen, height_error, offset_mm, least_share;                       /* how well */
} Keyframe;

/* Followed of follow.py. */
typedef struct {
    double pose[16], sums[SUMS], noise, covariance[36], forth[SUMS], back[SUMS], pixels, last_step, turn_variance, shift_variance, used, variance;
} Followed;

static Limits limits_of(const Keyframe *of, const Grid *in, const double *pose, double noise) {
    Limits at = {.x0 = in->x0, .y0 = in->y0, .pitch = in->pitch, .per_slope = 1.0 / (noise * noise), .per_height = of->per_height};
    at.score_slope = of->score_slope, at.score_height = of->score_height, at.deep = of->deep, at.shallow = of->shallow;
    memcpy(at.pose, pose, sizeof at.pose);
    return at;
}

static void sum_up(const Keyframe *of, const Grid *in, const Pixels *pixels, const double *pose, int score_only, double *sums) {
    const Limits at = limits_of(of, in, pose, of->slope_noise);
    alignment_sums(in->field, in->height, in->width, pixels->columns, pixels->stride, (int)pixels->number, score_only, &at, sums);
}

/* Moves the pose. sums: those of the last step, then the slope noise of its weights. */
static void refine(const Keyframe *of, const Grid *in, const Pixels *pixels, int steps, double wide, double small_mm, double *pose, double *sums) {
    Limits at = limits_of(of, in, pose, wide);
    Steps by = {.wide = wide, .least_noise = of->least_noise, .largest_mm = of->largest_mm, .small_mm = small_mm};
    memcpy(by.units, of->units, sizeof by.units), memcpy(by.center, of->center, sizeof by.center);
    refine_pose(in->field, in->height, in->width, pixels->columns, pixels->stride, (int)pixels->number, steps, &by, NULL, 0, &at, sums);
    memcpy(pose, at.pose, sizeof at.pose);
}

/* The matrix of the twists of a Gauss-Newton step. */
static void matrix_of(const double *sums, double scale, double A[6][6]) {
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) A[i][k] = scale * sums[SIZE * i + k];
}

static double trace_of(double A[6][6], int n) {
    double trace = 0.0;
    for (int k = 0; k < n; k++) trace += A[k][k];
    return trace;
}

/* Whether all eigenvalues of the symmetric A are at least `least`. */
static int all_at_least(double A[6][6], double least) {
    double L[6][6];
    for (int i = 0; i < 6; i++)
        for (int k = 0; k <= i; k++) {
            double left = A[i][k] - (i == k ? least : 0.0);
            for (int m = 0; m < k; m++) left -= L[i][m] * L[k][m];
            if (i == k && !(left >= 0.0)) return 0;
            L[i][k] = i == k ? sqrt(left > 1e-300 ? left : 1e-300) : left / L[k][k];
        }
    return 1;
}

/* The inverse of the first n rows and columns of a symmetric positive A; zeros in the others. */
static void invert(double A[6][6], int n, double inverse[6][6]) {
    for (int k = 0; k < 6; k++) {
        double B[6][6] = {{0.0}}, one[6] = {0.0};
        for (int i = 0; i < 6; i++)
            for (int m = 0; m < 6; m++) B[i][m] = i < n && m < n ? A[i][m] : i == m ? 1.0 : 0.0;
        one[k] = k < n ? 1.0 : 0.0;
        solve_six(B, one, inverse[k]);
    }
}

/* to = A * B * A^T */
static void both_sides(double A[6][6], double B[6][6], double to[6][6]) {
    double half[6][6] = {{0.0}};
    for (int i = 0; i < 6; i++)
        for (int m = 0; m < 6; m++)
            for (int k = 0; k < 6; k++) half[i][k] += A[i][m] * B[m][k];
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) {
            to[i][k] = 0.0;
            for (int m = 0; m < 6; m++) to[i][k] += half[i][m] * A[k][m];
        }
}

/* jackknife of jackknife.py, of parts (parts, SUMS) and their sum. */
static void leave_out(const double *parts, int number, const double *sums, double covariance[6][6]) {
    double whole[6][6], base[6];
    matrix_of(sums, 1.0, whole);
    const double damping = 1e-6 * fmax(trace_of(whole, 6), 1e-9);
    memset(covariance, 0, sizeof(double[6][6]));
    for (int p = -1; p < number; p++) { /* first none is left out */
        const double *part = parts + (int64_t)SUMS * p;
        double A[6][6], b[6], step[6];
        for (int i = 0; i < 6; i++) {
            for (int k = 0; k < 6; k++) A[i][k] = whole[i][k] - (p < 0 ? 0.0 : part[SIZE * i + k]);
            A[i][i] += damping;
            b[i] = sums[SIZE * i + 6] - (p < 0 ? 0.0 : part[SIZE * i + 6]);
        }
        solve_six(A, b, p < 0 ? base : step);
        for (int i = 0; i < 6 && p >= 0; i++)
            for (int k = 0; k < 6; k++) covariance[i][k] += (step[i] - base[i]) * (step[k] - base[k]) * (number - 1) / number;
    }
}

/* _covariance of follow.py. */
static void covariance_by_slopes(const Keyframe *of, const double *sums, double noise, double by_parts[6][6], double scaled[6][6]) {
    double A[6][6], white[6][6];
    matrix_of(sums, 1.0, A);
    invert(A, 5, white); /* heights have a weight of their own */
    const double ratio = slope_noise_of(sums) / noise;
    const double alike = 1.0 - ratio * ratio * trace_of(white, 5) / fmax(trace_of(by_parts, 5), 1e-30);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) {
            white[i][k] *= ratio * ratio;
            scaled[i][k] = white[i][k] + of->shared_error * (fmax(alike, 0.0) * by_parts[i][k] + of->unseen * white[i][k]);
        }
}

/* _covariance_of_both of follow.py: `scaled` is changed. */
static void covariance_of_both(const Keyframe *of, const double *slopes, const double *both, double scaled[6][6]) {
    double A[6][6], S[6][6], spread[6][6], share[6][6] = {{0.0}}, by_slopes[6][6], by_heights[6][6];
    matrix_of(both, 1.0, A), matrix_of(slopes, 1.0, S);
    const double damping = 1e-9 * trace_of(A, 6);
    for (int k = 0; k < 6; k++) A[k][k] += damping;
    invert(A, 6, spread);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) {
            A[i][k] = both[SIZE * i + k] - S[i][k];
            for (int m = 0; m < 6; m++) share[i][k] += spread[i][m] * S[m][k];
        }
    both_sides(share, scaled, by_slopes), both_sides(spread, A, by_heights);
    const double error = slope_noise_of(slopes) / of->height_error, size = 0.5 * error * error;
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) scaled[i][k] = by_slopes[i][k] + size * by_heights[i][k];
}

/* The matrix of a cross product with v. */
static void cross_of(const double v[3], double to[3][3]) {
    const double cross[3][3] = {{0.0, -v[2], v[1]}, {v[2], 0.0, -v[0]}, {-v[1], v[0], 0.0}};
    memcpy(to, cross, sizeof cross);
}

/* _after of follow.py: the covariance of a small motion after the pose. */
static void covariance_after(const Keyframe *of, const double *pose, double scaled[6][6], double after[6][6]) {
    const double shift[3] = {pose[3], pose[7], pose[11]};
    double moved[3][3], center[3][3], A[6][6] = {{0.0}};
    cross_of(shift, moved), cross_of(of->center, center);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) {
            A[i][k] = pose[4 * i + k] * of->units[k], A[3 + i][3 + k] = pose[4 * i + k] * of->units[3 + k];
            for (int m = 0; m < 3; m++) A[3 + i][k] += (moved[i][m] * pose[4 * m + k] + pose[4 * i + m] * center[m][k]) * of->units[k];
        }
    both_sides(A, scaled, after);
}

static void invert_pose(const double *pose, double *inverse) {
    for (int i = 0; i < 3; i++) {
        inverse[4 * i + 3] = 0.0;
        for (int k = 0; k < 3; k++) inverse[4 * i + k] = pose[4 * k + i], inverse[4 * i + 3] -= pose[4 * k + i] * pose[4 * k + 3];
    }
    for (int k = 0; k < 4; k++) inverse[12 + k] = k == 3;
}

/* in_common of follow.py: its sums, of slopes that may show five motions. */
static void show_common(const Keyframe *of, const Grid *fine, Followed *found) {
    double sums[SUMS], A[6][6], inverse[6][6];
    sum_up(of, fine, &of->some, found->pose, 0, sums);
    matrix_of(sums, 1.0, A);
    const double ridge = of->least_share * trace_of(A, 5) + 1e-9;
    for (int k = 0; k < 5; k++) A[k][k] += ridge;
    invert(A, 5, inverse);
    found->used = sums[USED], found->variance = trace_of(inverse, 5);
}

/* Of the poses (number, 16) the one that fits best on the coarse grid. */
static int best_start(const Keyframe *of, const Grid *coarse, const double *starts, int number) {
    double least_cost = INFINITY, sums[SUMS];
    int best = 0;
    for (int k = 0; k < number && number > 1; k++) {
        sum_up(of, coarse, &of->coarse, starts + 16 * k, 1, sums);
        const double cost = sums[BAD] / fmax(sums[COMPARED], 1.0);
        if (cost < least_cost) least_cost = cost, best = k;
    }
    return best;
}

/* The score of the pose on the coarse grids, from the keyframe to the frame and back. Returns 1 without memory. */
static int score(const Keyframe *of, const Grid *coarse, Followed *found) {
    double inverse[16];
    sum_up(of, coarse, &of->coarse, found->pose, 1, found->forth);
    const int64_t most = (int64_t)coarse->height * coarse->width;
    float *columns = malloc(5 * sizeof(float) * (size_t)most);
    if (!columns) return 1;
    Pixels pixels = {columns, most, 0};
    pixels.number = object_pixels(coarse->field, coarse->height, coarse->width, coarse->x0, coarse->y0, coarse->pitch, most, columns);
    invert_pose(found->pose, inverse);
    sum_up(of, &of->own, &pixels, inverse, 1, found->back);
    found->pixels = (double)pixels.number;
    free(columns);
    return 0;
}

/*
 * Registers a frame, on its fine and its coarse grid, to a keyframe that holds no motion, from the best of the poses `starts` (number, 16).
 * Returns which one that was; -1 where some motion is not known, which follow.py then finds out; -2 without memory.
 */
EXPORT int follow_frame(const Keyframe *of, const Grid *fine, const Grid *coarse, const double *starts, int number, Followed *found) {
    if (of->parts > MOST_PARTS) return -1;
    const int best = best_start(of, coarse, starts, number);
    double *pose = found->pose, last[SUMS + 1], A[6][6];
    memcpy(pose, starts + 16 * best, sizeof found->pose);
    refine(of, coarse, &of->coarse, of->coarse_steps, 2.0 * of->slope_noise, of->coarse_mm, pose, last);
    double ratio = last[SUMS] / of->slope_noise;
    matrix_of(last, ratio * ratio / fmax(last[USED], 1.0), A);
    if (!all_at_least(A, of->least_information)) return -1; /* _sliding */
    refine(of, fine, &of->some, of->some_steps, of->slope_noise, of->small_mm, pose, last);
    ratio = fmax(slope_noise_of(last), of->least_slope_noise) / last[SUMS];
    matrix_of(last, 1.0 / (of->alike * ratio * ratio), A);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) A[i][k] *= of->wanted[i] * of->wanted[k];
    if (!all_at_least(A, 1.0)) return -1; /* _vague */

    double parts[MOST_PARTS * SUMS], both[SUMS], heights[SIZE * SIZE], step[6], twist[6], by_parts[6][6], scaled[6][6];
    found->noise = fmax(of->least_noise, 1.5 * slope_noise_of(last));
    Limits at = limits_of(of, fine, pose, found->noise);
    part_sums(fine->field, fine->height, fine->width, of->many.columns, of->many.stride, (int)of->many.number, of->parts, &at, parts);
    memset(found->sums, 0, sizeof found->sums);
    for (int p = 0; p < of->parts; p++)
        for (int k = 0; k < SUMS; k++) found->sums[k] += parts[SUMS * p + k];
    solve_step(found->sums, NULL, 0, of->largest_mm, step);
    found->last_step = 0.0;
    for (int k = 0; k < 6; k++) found->last_step += step[k] * step[k];
    found->last_step = sqrt(found->last_step);
    leave_out(parts, of->parts, found->sums, by_parts);
    covariance_by_slopes(of, found->sums, found->noise, by_parts, scaled);

    at = limits_of(of, fine, pose, of->slope_noise);
    if (height_sums(fine->field, fine->height, fine->width, of->some.columns, of->some.stride, (int)of->some.number, &at, of->cell, of->per_cell, of->lines,
                    of->cells, of->modes, of->most_height_mm, of->white_mm, heights))
        return -2;
    const double share = (double)of->coarse.number / (double)of->many.number; /* slopes once for each coarse pixel */
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < SIZE; k++) found->sums[SIZE * i + k] *= share;
    memcpy(both, found->sums, sizeof both);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < SIZE; k++) both[SIZE * i + k] += heights[SIZE * i + k];
    solve_step(both, NULL, 0, of->largest_mm, step);
    covariance_of_both(of, found->sums, both, scaled);
    scaled[5][5] += found->sums[HEIGHTS] / fmax(found->sums[WEIGHT], 1e-9) + of->offset_mm * of->offset_mm;
    for (int k = 0; k < 6; k++) twist[k] = step[k] * of->units[k];
    move_pose(pose, twist, of->center);

    found->turn_variance = found->shift_variance = 0.0;
    for (int k = 0; k < 3; k++) found->turn_variance += scaled[k][k] * of->units[k] * of->units[k], found->shift_variance += scaled[3 + k][3 + k];
    covariance_after(of, pose, scaled, (double(*)[6])found->covariance);
    show_common(of, fine, found);
    return score(of, coarse, found) ? -2 : best;
}

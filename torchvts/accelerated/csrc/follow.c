/* A frame registered to a keyframe: the same results as torchvts/pose/follow.py, which explains them. */
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
    const double *per_cell, *lines, *products;
    int32_t cells, modes, parts, coarse_steps, some_steps;
    double units[6], center[3];
    Directions held;
    double bias[36], shown[36]; /* noise's part of the information, and what slopes may show */
    double per_height, score_slope, score_height, deep, shallow;                            /* of Limits */
    double slope_noise, least_noise, largest_mm, coarse_mm, small_mm;                        /* of Steps */
    double least_information, wanted[6], alike, least_slope_noise, most_height_mm, white_mm; /* what is known */
    double shared_error, unseen, height_error, offset_mm, least_share, unknown_variance;     /* how well */
} Keyframe;

/* Followed of follow.py. */
typedef struct {
    double pose[16], sums[SUMS], noise, covariance[36], forth[SUMS], back[SUMS], pixels, last_step, turn_variance, shift_variance, used, variance;
    double motions[36], shifts[9], unknown, slides; /* (6, unknown), (3, slides) */
} Followed;

/* Motions that are not known, and those among them that are pure shifts. */
typedef struct {
    Directions motions, shifts;
} Unknown;

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

/* The directions, (n, number). */
static void write_directions(const Directions *from, int n, double *to) {
    for (int h = 0; h < from->number; h++)
        for (int i = 0; i < n; i++) to[i * from->number + h] = from->line[h][i];
}

/* Moves the pose. sums: those of the last step, then the slope noise of its weights. */
static void refine(const Keyframe *of, const Grid *in, const Pixels *pixels, int steps, double wide, double small_mm, const Directions *held,
                   double *pose, double *sums) {
    double columns[36];
    write_directions(held, 6, columns);
    Limits at = limits_of(of, in, pose, wide);
    Steps by = {.wide = wide, .least_noise = of->least_noise, .largest_mm = of->largest_mm, .small_mm = small_mm};
    memcpy(by.units, of->units, sizeof by.units), memcpy(by.center, of->center, sizeof by.center);
    refine_pose(in->field, in->height, in->width, pixels->columns, pixels->stride, (int)pixels->number, steps, &by, columns, held->number,
                &at, sums);
    memcpy(pose, at.pose, sizeof at.pose);
}

/* The matrix of the twists of a Gauss-Newton step. */
static void matrix_of(const double *sums, double scale, double A[6][6]) {
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) A[i][k] = scale * sums[SIZE * i + k];
}

/* Of n twists from the first on, those of hardly any information A: free_directions of ambiguity.py. */
static void find_sliding(const Keyframe *of, double A[6][6], int first, int n, Directions *to) {
    double values[6], vectors[6][6], vector[6];
    eigen_six(A, first, n, values, vectors);
    to->number = 0;
    for (int m = 0; m < n; m++) {
        double noise = 0.0;
        for (int i = 0; i < n; i++) vector[i] = vectors[i][m];
        for (int i = 0; i < n; i++)
            for (int k = 0; k < n; k++) noise += vector[i] * of->bias[6 * (first + i) + first + k] * vector[k];
        if (values[m] < of->least_information + 3.0 * noise) add_direction(to, n, vector);
    }
}

/* _sliding of follow.py, by the sums of a step. */
static void find_all_sliding(const Keyframe *of, const double *sums, Unknown *unknown) {
    const double ratio = sums[SUMS] / of->slope_noise;
    double A[6][6];
    matrix_of(sums, ratio * ratio / fmax(sums[USED], 1.0), A);
    find_sliding(of, A, 0, 6, &unknown->motions), find_sliding(of, A, 3, 3, &unknown->shifts);
    if (of->held.number > 0) join_directions(&unknown->motions, &of->held, 6);
}

/* Of n twists from the first on, those of too large a standard deviation, by A of what is wanted. */
static void find_vague(const Keyframe *of, double A[6][6], int first, int n, Directions *to) {
    double values[6], vectors[6][6], vector[6];
    eigen_six(A, first, n, values, vectors);
    to->number = 0;
    for (int m = 0; m < n; m++) {
        for (int i = 0; i < n; i++) vector[i] = vectors[i][m] * of->wanted[first + i];
        if (values[m] < 1.0) add_direction(to, n, vector);
    }
}

/* _vague of follow.py, by the sums of a step. */
static void find_all_vague(const Keyframe *of, const double *sums, Unknown *vague) {
    const double ratio = fmax(slope_noise_of(sums), of->least_slope_noise) / sums[SUMS];
    double A[6][6], values[6], vectors[6][6];
    matrix_of(sums, 1.0 / (of->alike * ratio * ratio), A);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) A[i][k] *= of->wanted[i] * of->wanted[k];
    eigen_six(A, 0, 6, values, vectors);
    vague->motions.number = vague->shifts.number = 0;
    for (int k = 0; k < 6; k++)
        if (values[k] < 1.0) {
            find_vague(of, A, 0, 6, &vague->motions), find_vague(of, A, 3, 3, &vague->shifts);
            return;
        }
}

/* rotation_vector of inverse.py. */
static void rotation_of(const double *pose, double w[3]) {
    const double skew[3] = {0.5 * (pose[9] - pose[6]), 0.5 * (pose[2] - pose[8]), 0.5 * (pose[4] - pose[1])};
    const double sine = sqrt(skew[0] * skew[0] + skew[1] * skew[1] + skew[2] * skew[2]), cosine = 0.5 * (pose[0] + pose[5] + pose[10] - 1.0);
    double factor = sine > 1e-12 ? atan2(sine, cosine) / sine : 1.0;
    memcpy(w, skew, sizeof skew);
    if (cosine < -0.9) { /* the sine is small: the axis is that of (1 - cosine) a a^T */
        double square[3][3], size = 0.0, along = 0.0;
        int best = 0;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) square[i][k] = 0.5 * (pose[4 * i + k] + pose[4 * k + i]) - (i == k ? cosine : 0.0);
        for (int k = 1; k < 3; k++) best = square[k][k] > square[best][best] ? k : best;
        for (int i = 0; i < 3; i++) w[i] = square[i][best], size += w[i] * w[i], along += w[i] * skew[i];
        factor = (along < 0.0 ? -1.0 : 1.0) * atan2(sine, cosine) / sqrt(size);
    }
    for (int i = 0; i < 3; i++) w[i] *= factor;
}

static void invert_pose(const double *pose, double *inverse) {
    for (int i = 0; i < 3; i++) {
        inverse[4 * i + 3] = 0.0;
        for (int k = 0; k < 3; k++) inverse[4 * i + k] = pose[4 * k + i], inverse[4 * i + 3] -= pose[4 * k + i] * pose[4 * k + 3];
    }
    for (int k = 0; k < 4; k++) inverse[12 + k] = k == 3;
}

/* step_between of inverse.py: the scaled twist from one pose to another. */
static void step_between(const Keyframe *of, const double *pose, const double *other, double step[6]) {
    double back[16], moved[16];
    invert_pose(pose, back);
    for (int i = 0; i < 4; i++)
        for (int k = 0; k < 4; k++) {
            moved[4 * i + k] = 0.0;
            for (int m = 0; m < 4; m++) moved[4 * i + k] += back[4 * i + m] * other[4 * m + k];
        }
    rotation_of(moved, step);
    for (int i = 0; i < 3; i++) {
        step[3 + i] = moved[4 * i + 3] - of->center[i];
        for (int k = 0; k < 3; k++) step[3 + i] += moved[4 * i + k] * of->center[k];
    }
    for (int k = 0; k < 6; k++) step[k] /= of->units[k];
}

/* _kept of follow.py: moves the pose by what is unknown to where that has its last value, rotations first. */
static void keep(const Keyframe *of, const Directions *unknown, const double *last, double *pose) {
    if (unknown->number == 0) return;
    double step[6], A[6][6], b[6] = {0.0}, size[6];
    step_between(of, last, pose, step);
    for (int h = 0; h < 6; h++)
        for (int g = 0; g < 6; g++) {
            A[h][g] = h == g ? 1.0 : 0.0;
            if (h >= unknown->number || g >= unknown->number) continue;
            A[h][g] = 0.0;
            for (int i = 0; i < 6; i++) A[h][g] += unknown->line[h][i] * unknown->line[g][i] * (i < 3 ? 1.0 : 1e-3);
        }
    for (int h = 0; h < unknown->number; h++)
        for (int i = 0; i < 6; i++) b[h] += unknown->line[h][i] * step[i] * (i < 3 ? 1.0 : 1e-3);
    solve_six(A, b, size);
    for (int h = 0; h < unknown->number; h++)
        for (int i = 0; i < 6; i++) step[i] -= size[h] * unknown->line[h][i];
    for (int k = 0; k < 6; k++) step[k] *= of->units[k];
    memcpy(pose, last, 16 * sizeof *pose);
    move_pose(pose, step, of->center);
}

/* jackknife of jackknife.py, of parts (parts, SUMS) and their sum, among the twists that P leaves. */
static void leave_out(const double *parts, int number, const double *sums, double P[6][6], double covariance[6][6]) {
    double whole[6][6], left[6][6], base[6];
    matrix_of(sums, 1.0, whole), both_sides(P, whole, left);
    const double size = fmax(trace_of(left, 6), 1e-9);
    memset(covariance, 0, sizeof(double[6][6]));
    for (int p = -1; p < number; p++) { /* first none is left out */
        const double *part = parts + (int64_t)SUMS * p;
        double A[6][6], b[6] = {0.0}, step[6];
        for (int i = 0; i < 6; i++)
            for (int k = 0; k < 6; k++) {
                A[i][k] = whole[i][k] - (p < 0 ? 0.0 : part[SIZE * i + k]);
                b[i] += P[i][k] * (sums[SIZE * k + 6] - (p < 0 ? 0.0 : part[SIZE * k + 6]));
            }
        both_sides(P, A, left);
        for (int i = 0; i < 6; i++)
            for (int k = 0; k < 6; k++) left[i][k] += size * ((i == k) - (1.0 - 1e-6) * P[i][k]); /* damping; the others get no step */
        solve_six(left, b, p < 0 ? base : step);
        for (int i = 0; i < 6 && p >= 0; i++)
            for (int k = 0; k < 6; k++) covariance[i][k] += (step[i] - base[i]) * (step[k] - base[k]) * (number - 1) / number;
    }
}

/* _covariance of follow.py, among the twists that P leaves. */
static void covariance_by_slopes(const Keyframe *of, const double *sums, double noise, double P[6][6], double by_parts[6][6], double scaled[6][6]) {
    double A[6][6], left[6][6], values[6], vectors[6][6], white[6][6] = {{0.0}}, most = 0.0;
    matrix_of(sums, 1.0, A), both_sides(P, A, left);
    for (int k = 0; k < 6; k++) left[5][k] = left[k][5] = 0.0; /* heights have a weight of their own */
    eigen_six(left, 0, 6, values, vectors);
    for (int k = 0; k < 6; k++) most = fmax(most, values[k]);
    const double ratio = slope_noise_of(sums) / noise;
    for (int m = 0; m < 6; m++)
        for (int i = 0; i < 6 && values[m] > 1e-9 * most; i++)
            for (int k = 0; k < 6; k++) white[i][k] += ratio * ratio * vectors[i][m] * vectors[k][m] / values[m];
    const double alike = 1.0 - trace_of(white, 6) / fmax(trace_of(by_parts, 5), 1e-30);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) scaled[i][k] = white[i][k] + of->shared_error * (fmax(alike, 0.0) * by_parts[i][k] + of->unseen * white[i][k]);
}

/* _covariance_of_both of follow.py: `scaled` is changed. */
static void covariance_of_both(const Keyframe *of, const double *slopes, const double *both, double scaled[6][6]) {
    double A[6][6], S[6][6], spread[6][6], share[6][6] = {{0.0}}, by_slopes[6][6], by_heights[6][6];
    matrix_of(both, 1.0, A), matrix_of(slopes, 1.0, S);
    const double damping = 1e-9 * trace_of(A, 6);
    for (int k = 0; k < 6; k++) A[k][k] += damping;
    invert_six(A, spread);
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

/* in_common of follow.py: its sums, of what slopes may show. */
static void show_common(const Keyframe *of, const Grid *fine, Followed *found) {
    double sums[SUMS], A[6][6], P[6][6], left[6][6], values[6], vectors[6][6];
    sum_up(of, fine, &of->some, found->pose, 0, sums);
    memcpy(P, of->shown, sizeof P);
    matrix_of(sums, 1.0, A), both_sides(P, A, left);
    const double size = trace_of(left, 6), ridge = of->least_share * size + 1e-9, aside = 2.0 * size + 1.0;
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) left[i][k] += aside * (P[i][k] - (i == k)); /* below zero are the others */
    eigen_six(left, 0, 6, values, vectors);
    found->used = sums[USED], found->variance = 0.0;
    for (int k = 0; k < 6; k++) found->variance += values[k] > -0.5 * aside ? 1.0 / (fmax(values[k], 0.0) + ridge) : 0.0;
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

/* _with_heights of follow.py, where all motions are known: the step and its covariance by slopes and heights. Returns 1 without memory. */
static int step_with_heights(const Keyframe *of, const Grid *fine, const double *pose, double *slopes, double step[6], double scaled[6][6]) {
    double both[SUMS], heights[SIZE * SIZE];
    const Limits at = limits_of(of, fine, pose, of->slope_noise);
    if (height_sums(fine->field, fine->height, fine->width, of->some.columns, of->some.stride, (int)of->some.number, &at, of->cell, of->per_cell, of->lines,
                    of->products, of->cells, of->modes, of->most_height_mm, of->white_mm, heights))
        return 1;
    const double share = (double)of->coarse.number / (double)of->many.number; /* slopes once for each coarse pixel */
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < SIZE; k++) slopes[SIZE * i + k] *= share;
    memcpy(both, slopes, sizeof both);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < SIZE; k++) both[SIZE * i + k] += heights[SIZE * i + k];
    solve_step(both, NULL, 0, of->largest_mm, step);
    covariance_of_both(of, slopes, both, scaled);
    return 0;
}

/* The last step, by many pixels, from a pose that some of them gave. Returns 1 without memory. */
static int last_step(const Keyframe *of, const Grid *fine, const Unknown *unknown, const double *last, const double *some, Followed *found) {
    double parts[MOST_PARTS * SUMS], step[6], P[6][6], by_parts[6][6], scaled[6][6];
    found->noise = fmax(of->least_noise, 1.5 * slope_noise_of(some));
    const Limits at = limits_of(of, fine, found->pose, found->noise);
    part_sums(fine->field, fine->height, fine->width, of->many.columns, of->many.stride, (int)of->many.number, of->parts, &at, parts);
    memset(found->sums, 0, sizeof found->sums);
    for (int p = 0; p < of->parts; p++)
        for (int k = 0; k < SUMS; k++) found->sums[k] += parts[SUMS * p + k];
    solve_step(found->sums, found->motions, unknown->motions.number, of->largest_mm, step);
    found->last_step = 0.0;
    for (int k = 0; k < 6; k++) found->last_step += step[k] * step[k];
    found->last_step = sqrt(found->last_step);
    beside_directions(&unknown->motions, P);
    leave_out(parts, of->parts, found->sums, P, by_parts);
    covariance_by_slopes(of, found->sums, found->noise, P, by_parts, scaled);
    if (unknown->motions.number == 0 && step_with_heights(of, fine, found->pose, found->sums, step, scaled)) return 1;
    scaled[5][5] += found->sums[HEIGHTS] / fmax(found->sums[WEIGHT], 1e-9) + of->offset_mm * of->offset_mm;
    for (int k = 0; k < 6; k++) step[k] *= of->units[k];
    move_pose(found->pose, step, of->center);
    keep(of, &unknown->motions, last, found->pose);
    found->turn_variance = found->shift_variance = 0.0;
    for (int k = 0; k < 3; k++)
        found->turn_variance += scaled[k][k] * of->units[k] * of->units[k], found->shift_variance += scaled[3 + k][3 + k];
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) scaled[i][k] += of->unknown_variance * ((i == k) - P[i][k]);
    covariance_after(of, found->pose, scaled, (double(*)[6])found->covariance);
    return 0;
}

/*
 * Registers a frame, on its fine and its coarse grid, to a keyframe, from the best of the poses `starts` (number, 16). What is unknown
 * keeps its value in the pose `last`. Returns which start that was, or -1 without memory.
 */
EXPORT int follow_frame(
    const Keyframe *of, const Grid *fine, const Grid *coarse, const double *starts, int number, const double *last, Followed *found) {
    const int best = best_start(of, coarse, starts, number);
    double *pose = found->pose, sums[SUMS + 1];
    Unknown unknown, vague;
    memcpy(pose, starts + 16 * best, sizeof found->pose);
    refine(of, coarse, &of->coarse, of->coarse_steps, 2.0 * of->slope_noise, of->coarse_mm, &of->held, pose, sums);
    find_all_sliding(of, sums, &unknown);
    keep(of, &unknown.motions, last, pose);
    double start[16];
    memcpy(start, pose, sizeof start);
    refine(of, fine, &of->some, of->some_steps, of->slope_noise, of->small_mm, &unknown.motions, pose, sums);
    find_all_vague(of, sums, &vague);
    if (vague.motions.number > 0) {
        join_directions(&unknown.motions, &vague.motions, 6), join_directions(&unknown.shifts, &vague.shifts, 3);
        memcpy(pose, start, sizeof start);
        keep(of, &unknown.motions, last, pose);
        refine(of, fine, &of->some, of->some_steps, of->slope_noise, of->small_mm, &unknown.motions, pose, sums);
    }
    found->unknown = unknown.motions.number, found->slides = unknown.shifts.number;
    write_directions(&unknown.motions, 6, found->motions), write_directions(&unknown.shifts, 3, found->shifts);
    if (last_step(of, fine, &unknown, last, sums, found)) return -1;
    show_common(of, fine, found);
    return score(of, coarse, found) ? -1 : best;
}

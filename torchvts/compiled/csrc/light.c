/* The light of a frame over that of the background: Relight of torchvts/compensate/light.py, which explains it. */
#include "plan.h"

enum { TERMS = 6, FORMS = TERMS * (TERMS + 1) / 2, LANES = VECTOR / sizeof(double) };

/* LANES values that one instruction works on, which may lie anywhere in memory. Of this type, all sums below stay in registers. */
typedef double Lanes __attribute__((vector_size(sizeof(double) * LANES), aligned(sizeof(double)), may_alias));
typedef int64_t Bits __attribute__((vector_size(sizeof(double) * LANES), aligned(sizeof(double)), may_alias));

static inline Lanes lanes_at(const double *values) { return *(const Lanes *)values; }
static inline Lanes larger(Lanes a, Lanes b) { return (Lanes)(((Bits)a & (a > b)) | ((Bits)b & ~(a > b))); }

/* Samples of a frame, (3, n) each, n a multiple of LANES: light / (background + pedestal), the least that may be left of it, whether it counts;
   and share (3, n), the same ratio of the background. In double, so that the order of sums leaves no trace in the result. */
typedef struct {
    double *relative, *lowest, *counts;
    const double *share;
    int n, samples;
} Samples;

/* The mean of 3 x 3 pixels around a place, and the largest; of a single one where these would overlap. */
static float sample(const float *image, int width, int stride, int row, int column, float *largest) {
    const float *a = image + (size_t)(row * stride + stride / 2) * width + column * stride + stride / 2;
    if (stride < 3) return *largest = *a;
    float total = 0.0f, most = 0.0f;
    a -= width + 1;
    for (int i = 0; i < 3; i++, a += width)
        for (int j = 0; j < 3; j++) {
            total = i + j ? total + a[j] : a[j];
            most = i + j && most > a[j] ? most : a[j];
        }
    *largest = most;
    return total / 9.0f;
}

/* Takes the samples of a frame; lost: the share that is black or saturated; known: whether a channel has enough others. */
static void take(const Plan *plan, const float *image, Samples *some, float *lost, int known[3]) {
    const size_t pixels = (size_t)plan->height * plan->width;
    const int n = some->n, columns = (int)plan->relight_columns;
    for (int c = 0; c < 3; c++) {
        double valid = 0.0, usable = 0.0, *relative = some->relative + (size_t)c * n, *counts = some->counts + (size_t)c * n;
        const double *share = some->share + (size_t)c * n;
        for (int k = 0, row = 0, column = 0; k < some->samples; k++) {
            float largest, mean = sample(image + pixels * c, (int)plan->width, (int)plan->relight_stride, row, column, &largest);
            const int lit = share[k] > 0.0 && mean > (float)plan->black, saturated = largest >= (float)plan->saturation_light;
            relative[k] = (double)(mean / plan->relight_skin[(size_t)c * some->samples + k]);
            some->lowest[(size_t)c * n + k] = saturated ? 0.0 : -HUGE_VAL;
            counts[k] = lit, valid += lit && !saturated, usable += share[k] > 0.0;
            if (++column == columns) column = 0, row++;
        }
        lost[c] = (float)((usable - valid) / (usable > 1.0 ? usable : 1.0));
        known[c] = valid > (1.0 - plan->lost) * usable;
        for (int k = 0; k < n && !known[c]; k++) counts[k] = 0.0;
    }
}

/* What a sample is brighter than its share of 1 + a surface. */
static inline Lanes left_of(const Samples *some, int c, int k, Lanes scale, Lanes surface) {
    const size_t at = (size_t)c * some->n + k;
    return larger(lanes_at(some->relative + at) / scale - lanes_at(some->share + at) - surface, lanes_at(some->lowest + at)) * lanes_at(some->counts + at);
}

static inline Lanes surface_at(const double *place, const double *found, int n, int k) {
    Lanes sum = lanes_at(place + k) * found[0];
    for (int j = 1; j < TERMS; j++) sum += lanes_at(place + (size_t)j * n + k) * found[j];
    return sum;
}

static double sum_of(Lanes values) {
    double sum = 0.0;
    for (int j = 0; j < LANES; j++) sum += values[j];
    return sum;
}

/* How many samples lie near a surface: Tukey's weight at a scale. */
WIDE static double support(const Samples *some, const double *place, const double level[3], const double found[3][TERMS], double scale) {
    const Lanes zero = {0.0};
    const int n = some->n;
    Lanes total = zero;
    for (int k = 0; k < n; k += LANES) {
        Lanes squared = zero, counts = zero;
        for (int c = 0; c < 3; c++) {
            const Lanes surface = found ? surface_at(place + (size_t)c * TERMS * n, found[c], n, k) : zero;
            const Lanes off = left_of(some, c, k, zero + level[c], surface);
            squared += off * off;
            counts = larger(counts, lanes_at(some->counts + (size_t)c * n + k));
        }
        const Lanes weight = larger(1.0 - squared / (12.0 * scale * scale), zero);
        total += weight * weight * counts;
    }
    return sum_of(total);
}

/* Relight.level(). */
static void find_level(const Plan *plan, const Samples *some, double level[3]) {
    const int every = (int)plan->relight_every, columns = (int)plan->relight_columns;
    double best;
    level[0] = level[1] = level[2] = 1.0;
    best = support(some, NULL, level, NULL, plan->alike);
    for (int row = every / 2; row < plan->relight_rows; row += every)
        for (int column = every / 2; column < columns; column += every) {
            double candidate[3], mean = 0.0, count = 0.0;
            const int k = row * columns + column;
            for (int c = 0; c < 3; c++) {
                const size_t at = (size_t)c * some->n + k;
                candidate[c] = some->relative[at] / (some->share[at] > 1e-6 ? some->share[at] : 1e-6);
                mean += candidate[c] * some->counts[at], count += some->counts[at];
            }
            mean /= count > 1.0 ? count : 1.0;
            for (int c = 0; c < 3; c++) {
                const double value = some->counts[(size_t)c * some->n + k] > 0.0 ? candidate[c] : mean;
                candidate[c] = value < 0.1 ? 0.1 : value > 10.0 ? 10.0 : value;
            }
            const double found = support(some, NULL, candidate, NULL, plan->alike);
            if (found > best) best = found, memcpy(level, candidate, sizeof candidate);
        }
}

/* The sums of a step of the fit: lower triangle of the quadratic form and right side, of one channel. weight (n): what counts of its samples. */
WIDE FUSED static void form_of(const Samples *some, int c, const double *place, const double *weight, const double *off, double form[FORMS], double right[TERMS]) {
    const Lanes zero = {0.0};
    const int n = some->n;
    Lanes sums[FORMS + TERMS];
    for (int j = 0; j < FORMS + TERMS; j++) sums[j] = zero;
    for (int k = 0; k < n; k += LANES) {
        const Lanes counted = lanes_at(weight + k) * lanes_at(some->counts + (size_t)c * n + k), error = lanes_at(off + k);
        Lanes term[TERMS];
        for (int j = 0; j < TERMS; j++) term[j] = lanes_at(place + (size_t)j * n + k);
        UNROLLED for (int j = 0; j < TERMS; j++) {
            const Lanes scaled = term[j] * counted;
            UNROLLED for (int i = 0; i <= j; i++) sums[j * (j + 1) / 2 + i] += scaled * term[i];
            sums[FORMS + j] += scaled * error;
        }
    }
    for (int j = 0; j < FORMS; j++) form[j] = sum_of(sums[j]);
    for (int j = 0; j < TERMS; j++) right[j] = sum_of(sums[FORMS + j]);
}

/* Solves a positive definite system by Cholesky's decomposition, in place. */
static void solve(double form[FORMS], double right[TERMS]) {
    for (int j = 0; j < TERMS; j++)
        for (int i = 0; i <= j; i++) {
            double *at = form + j * (j + 1) / 2 + i;
            for (int k = 0; k < i; k++) *at -= form[j * (j + 1) / 2 + k] * form[i * (i + 1) / 2 + k];
            *at = i == j ? sqrt(*at) : *at / form[i * (i + 1) / 2 + i];
        }
    for (int j = 0; j < TERMS; j++) {
        for (int k = 0; k < j; k++) right[j] -= form[j * (j + 1) / 2 + k] * right[k];
        right[j] /= form[j * (j + 1) / 2 + j];
    }
    for (int j = TERMS - 1; j >= 0; j--) {
        for (int k = j + 1; k < TERMS; k++) right[j] -= form[k * (k + 1) / 2 + j] * right[k];
        right[j] /= form[j * (j + 1) / 2 + j];
    }
}

/* What samples leave of a surface, off (3, n), and Tukey's weight of each, weight (n). */
WIDE static void weigh_samples(const Samples *some, const double *place, const double level[3], const double found[3][TERMS], double scale, double *off, double *weight) {
    const Lanes zero = {0.0};
    const int n = some->n;
    for (int k = 0; k < n; k += LANES) {
        Lanes squared = zero;
        for (int c = 0; c < 3; c++) {
            const Lanes left = left_of(some, c, k, zero + level[c], surface_at(place + (size_t)c * TERMS * n, found[c], n, k));
            *(Lanes *)(off + (size_t)c * n + k) = left;
            squared += left * left;
        }
        const Lanes near = larger(1.0 - squared / (12.0 * scale * scale), zero);
        *(Lanes *)(weight + k) = near * near;
    }
}

/* Relight.fit(): the coefficients (3, TERMS) of the first `terms` terms, 1 or all, that the samples stay near. */
static void fit(const Plan *plan, const Samples *some, const double level[3], int terms, double *off, double found[3][TERMS]) {
    const double *place = plan->relight_place;
    double *weight = off + 3 * (size_t)some->n;
    memset(found, 0, 3 * TERMS * sizeof(double));
    for (int step = 0; step < plan->relight_steps; step++) {
        weigh_samples(some, place, level, found, plan->relight_scales[step], off, weight);
        for (int c = 0; c < 3; c++) {
            double form[FORMS], right[TERMS];
            form_of(some, c, place + (size_t)c * TERMS * some->n, weight, off + (size_t)c * some->n, form, right);
            for (int j = 0; j < FORMS; j++) form[j] /= (double)some->samples;
            for (int j = 0; j < TERMS; j++) form[j * (j + 1) / 2 + j] += plan->damping, right[j] /= (double)some->samples;
            if (terms == 1) right[0] /= form[0];
            else solve(form, right);
            for (int j = 0; j < terms; j++) found[c][j] += right[j];
        }
    }
}

/* Relight.terms() from the samples on: the coefficients (3, TERMS). */
static void find_terms(const Plan *plan, const Samples *some, const int known[3], double *off, float *terms) {
    const double unchanged[3] = {1.0, 1.0, 1.0};
    const int channels = known[0] + known[1] + known[2];
    double level[3], found[3][TERMS], all[3][TERMS], best = plan->better * support(some, NULL, unchanged, NULL, plan->exact);
    find_level(plan, some, level);
    for (int k = 0; k < 3 * TERMS; k++) terms[k] = k % TERMS == 0;
    for (int count = 1; count <= TERMS; count += TERMS - 1) {
        fit(plan, some, level, count, off, found);
        const double better = support(some, plan->relight_place, level, found, plan->exact);
        for (int c = 0; c < 3; c++)
            for (int j = 0; j < TERMS; j++) {
                const double *to = plan->relight_terms + (size_t)c * TERMS * TERMS;
                all[c][j] = j == 0;
                for (int k = 0; k < TERMS; k++) all[c][j] += found[c][k] * to[k * TERMS + j];
                all[c][j] *= level[c];
            }
        for (int k = 0; k < 3 * TERMS && better > best; k++) {
            const int c = k / TERMS, j = k % TERMS;
            const double mean = (all[0][j] * known[0] + all[1][j] * known[1] + all[2][j] * known[2]) / (channels ? channels : 1);
            terms[k] = (float)(known[c] ? all[c][j] : mean);
        }
        best = better * plan->better > best ? better * plan->better : best;
    }
}

int frame_light(const Plan *plan, Scratch *scratch, const float *image, float *terms) {
    const int n = (int)plan->relight_padded;
    const size_t before = scratch->used, bytes = 13 * sizeof(double) * (size_t)n;
    double *memory = lend(scratch, bytes);
    if (!memory) return NO_MEMORY;
    memset(memory, 0, bytes);
    Samples some = {memory, memory + 3 * (size_t)n, memory + 6 * (size_t)n, plan->relight_share, n, (int)(plan->relight_rows * plan->relight_columns)};
    int known[3];
    take(plan, image, &some, terms + 3 * TERMS, known);
    find_terms(plan, &some, known, memory + 9 * (size_t)n, terms);
    give_back(scratch, before);
    return DONE;
}

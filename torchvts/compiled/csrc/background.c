/* A new image without contact for a unit by a response field: what model/calibration.py, compensate/ and skin/weight.py make of one, in the same order. */
#include "load.h"

enum { WINDOW = 7, NOISE_SAMPLES = 8000, TERMS = 6 };

/* Constants of Python, under their names there. */
static const double PEDESTAL = 0.03, DEFECT_RATIO = 4.0, SATURATED = 0.995, EXACT = 0.002, FAILED_LIGHT = 0.05, QUANTISATION_STD = 1.0 / 255.0 / 3.4641016151377544;

/* The lower median of n values, which are sorted; other: as many more. */
static float median(float *values, float *other, int n) { return sorted(values, other, n)[(n - 1) / 2]; }

/* noise_std() of core/noise.py, of a plane. */
float noise_of(const float *image, int height, int width, float *some) {
    const int side = (int)ceil(sqrt((double)height * width / NOISE_SAMPLES)), stride = least(side > 1 ? side : 1, least(height, width));
    int n = 0;
    for (int y = stride / 2; y < height; y += stride)
        for (int x = 0; x < width - 2; x += stride, n++) {
            const float *at = image + (size_t)y * width + x;
            some[n] = fabsf(at[1] - 0.5f * (at[0] + at[2]));
        }
    if (!n) return 0.0f;
    const float *ordered = sorted(some, some + n, n);
    float std = 1.5f * (ordered[(n - 1) / 2] / 0.6745f);
    for (int round = 0; round < 2; round++) {
        double sum = 0.0;
        int k = 0;
        for (; k < n && ordered[k] <= 3.0f * std; k++) sum += (double)(ordered[k] * ordered[k]);
        std = (float)sqrt(sum / (k > 1 ? k : 1) / 0.97334);
    }
    return std / (float)sqrt(1.5);
}

/* Whether the background of a pixel is far from the median around it, where the extremes there do not show that it is no defect. */
static int is_far(const float *light, int height, int width, int y, int x, float floor) {
    const float here = light[(size_t)y * width + x];
    float around[2 * WINDOW * WINDOW], most = here, smallest = here;
    for (int k = 0, row = y - WINDOW / 2; row <= y + WINDOW / 2; row++)
        for (int column = x - WINDOW / 2; column <= x + WINDOW / 2; column++, k++) {
            const int i = row < 0 ? 0 : least(row, height - 1), j = column < 0 ? 0 : least(column, width - 1);
            around[k] = light[(size_t)i * width + j];
            most = fmaxf(most, around[k]), smallest = fminf(smallest, around[k]);
        }
    const float ratio = (float)DEFECT_RATIO;
    if (!(here * ratio < most || here > smallest * ratio)) return 0;
    const float usual = median(around, around + WINDOW * WINDOW, WINDOW * WINDOW);
    return (here * ratio < usual || here > usual * ratio) && fmaxf(usual, here) > floor;
}

/* nearest_valid() of defects.py: four valid pixels for each defect; bad: 1 for each pixel that is one. 0 where one has none in its row and column. */
static int find_neighbours(const uint8_t *bad, int height, int width, const int64_t *defect, int64_t count, int64_t *neighbours) {
    static const int STEP[4][2] = {{0, -1}, {0, 1}, {-1, 0}, {1, 0}}; /* the opposite of d is d ^ 1 */
    for (int64_t k = 0; k < count; k++, neighbours += 4) {
        int64_t found[4], any = -1;
        for (int d = 3; d >= 0; d--) {
            int64_t y = defect[k] / width, x = defect[k] % width, inside;
            while ((inside = y >= 0 && y < height && x >= 0 && x < width) && bad[y * width + x]) y += STEP[d][0], x += STEP[d][1];
            found[d] = inside ? y * width + x : -1, any = inside ? found[d] : any;
        }
        if (any < 0) return 0;
        for (int d = 0; d < 4; d++) neighbours[d] = found[d] >= 0 ? found[d] : found[d ^ 1] >= 0 ? found[d ^ 1] : any;
    }
    return 1;
}

/* _orthonormal() of light.py: of terms (TERMS, n), place (TERMS, step) and what makes it of them (TERMS, TERMS), in single precision as there. */
static void orthonormal(const double *terms, int n, double *place, size_t step, double *to_terms) {
    double lower[TERMS][TERMS];
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = 0; k < n; k++) sum += terms[i * n + k] * terms[j * n + k];
            sum = sum / n + (i == j ? 1e-9 : 0.0);
            for (int k = 0; k < j; k++) sum -= lower[i][k] * lower[j][k];
            lower[i][j] = i == j ? sqrt(sum) : sum / lower[j][j];
        }
    for (int k = -TERMS; k < n; k++) { /* the columns of one, then those of the terms, divided by the triangle */
        double solved[TERMS];
        for (int i = 0; i < TERMS; i++) {
            solved[i] = k < 0 ? i == k + TERMS : terms[i * n + k];
            for (int j = 0; j < i; j++) solved[i] -= lower[i][j] * solved[j];
            solved[i] /= lower[i][i];
            *(k < 0 ? to_terms + i * TERMS + k + TERMS : place + i * step + k) = (float)solved[i];
        }
    }
}

/* Relight.__init__(): the samples of a channel of the background. terms: TERMS * samples doubles. */
static void sample_skin(const Plan *p, int c, float *skin, double *share, double *place, double *to_terms, double *terms) {
    const int stride = (int)p->relight_stride, height = (int)p->height, width = (int)p->width, columns = (int)p->relight_columns, n = (int)SAMPLES;
    const int reach = stride >= 3, count = (2 * reach + 1) * (2 * reach + 1);
    for (int k = 0; k < n; k++) {
        const int row = k / columns * stride + stride / 2, column = k % columns * stride + stride / 2;
        const double y1 = p->along_y[row], y2 = p->along_y[height + row], x1 = p->along_x[column], x2 = p->along_x[width + column];
        const float *at = p->background + (size_t)c * PIXELS + (size_t)row * width + column;
        double sum = 0.0, most = 0.0;
        for (int i = -reach; i <= reach; i++)
            for (int j = -reach; j <= reach; j++) sum += at[i * width + j], most = fmax(most, at[i * width + j]);
        const double mean = sum / count, part = mean > p->black && most < p->saturation_light ? mean / (mean + PEDESTAL) : 0.0;
        skin[k] = (float)(mean + PEDESTAL), share[k] = (float)part;
        const double term[TERMS] = {1.0, x1, y1, x2, x1 * y1, y2};
        for (int t = 0; t < TERMS; t++) terms[t * n + k] = part * term[t];
    }
    orthonormal(terms, n, place, (size_t)p->relight_padded, to_terms);
}

/* The noise of linear light of an image of noise `std`. */
static double light_noise(double light, double std, double exponent) {
    return exponent == 1.0 ? std : exponent * pow(fmax(pow(fmax(light, 1e-6), 1.0 / exponent), std), exponent - 1.0) * std;
}

uint8_t *with_background(const Plan *old, const float *image, const char *about, size_t about_size, size_t *size, char *reason) {
    Plan plan = *old, *p = &plan;
    const int height = (int)p->height, width = (int)p->width, pixels = height * width, samples = (int)SAMPLES, padded = (int)p->relight_padded;
    if (p->by_lights || !p->gain)
        return refuse(reason, "the plan is one of point lights, which were fitted together with its background: save another from Python"), NULL;
    const size_t floats = 13 * (size_t)pixels + 3 * (size_t)samples, doubles = 21 * (size_t)padded + 108 + TERMS * (size_t)samples;
    char *block = calloc(1, sizeof(double) * doubles + 5 * sizeof(int64_t) * (size_t)pixels + sizeof(float) * (floats + width) + (size_t)pixels);
    if (!block) return refuse(reason, "no memory is left for the background"), NULL;
    double *share = (double *)block, *place = share + 3 * padded, *to_terms = place + 18 * padded, *terms = to_terms + 108;
    int64_t *defect = (int64_t *)(share + doubles), *neighbours = defect + pixels;
    float *light = (float *)(neighbours + 4 * (size_t)pixels), *gain = light + 3 * (size_t)pixels, *per_light = gain + 3 * (size_t)pixels;
    float *noise = per_light + 3 * (size_t)pixels, *some = noise + pixels, *skin = some + 3 * (size_t)pixels, *line = skin + 3 * samples;
    uint8_t *bad = (uint8_t *)(line + width);
    double most = 0.0, square = 0.0, std[3];
    Scratch scratch = {0};
    const int code = p->marker_diameter > 0.0 ? fill_markers(p, &scratch, image, light) : DONE;
    free_scratch(&scratch);
    if (code != DONE) return free(block), refuse(reason, "no memory is left for the background"), NULL;
    if (p->marker_diameter > 0.0) image = light;
    int lit = 0;
    for (int c = 0; c < 3; c++) {
        const size_t at = (size_t)c * pixels;
        std[c] = fmaxf(noise_of(image + at, height, width, some), (float)QUANTISATION_STD);
        for (int k = 0; k < pixels; k++) {
            light[at + k] = p->exponent == 1.0 ? image[at + k] : (float)pow(image[at + k], p->exponent);
            const float off = (float)light_noise(light[at + k], std[c], p->exponent);
            lit |= light[at + k] > off, most = fmax(most, off);
            gain[at + k] = 1.0f / (light[at + k] + (float)PEDESTAL);
            per_light[at + k] = some[k] = 1.0f - (float)PEDESTAL * gain[at + k];
        }
        const float typical = (float)FAILED_LIGHT * median(some, some + pixels, pixels);
        for (int k = 0; k < pixels; k++) {
            const float off = (float)light_noise(light[at + k], std[c], p->exponent), seen = off / (light[at + k] + (float)PEDESTAL);
            per_light[at + k] = 1.0f / fmaxf(fmaxf(per_light[at + k], typical), 1e-6f);
            noise[k] += off * gain[at + k] * per_light[at + k] * (off * gain[at + k] * per_light[at + k]);
            bad[k] |= (uint8_t)is_far(light + at, height, width, k / width, k % width, 3.0f * off), some[k] = seen * seen;
        }
        square += median(some, some + pixels, pixels) / 3.0;
    }
    p->background = light, p->gain = gain, p->per_light = per_light;
    p->pedestal = (float[3]){(float)PEDESTAL, (float)PEDESTAL, (float)PEDESTAL};
    p->saturation_light = pow(SATURATED, p->exponent) - 3.0 * most;
    p->exact = fmax(EXACT, 0.5 * sqrt(2.0 * square) / (p->relight_stride < 3 ? 1.0 : 3.0));
    for (int k = 0; k < pixels; k++) some[k] = noise[k] = sqrtf(noise[k] / 3.0f);
    const float usual = median(some, some + pixels, pixels);
    for (int k = 0; k < pixels; k++) noise[k] = fminf(usual / noise[k], 1.0f);
    cell_means(noise, width, (int)p->mask_cell, (int)ROWS(mask_cell), (int)COLUMNS(mask_cell), line, some);
    p->mask_noise = some;
    p->defects = 0;
    for (int k = 0; k < pixels; k++)
        if (bad[k]) defect[p->defects++] = k;
    for (int c = 0; c < 3; c++) sample_skin(p, c, skin + c * samples, share + c * padded, place + TERMS * c * padded, to_terms + 36 * c, terms);
    p->defect = defect, p->neighbours = neighbours;
    p->relight_skin = skin, p->relight_share = share, p->relight_place = place, p->relight_terms = to_terms;
    uint8_t *bytes = NULL;
    if (!lit) refuse(reason, "image: expected light above the noise, got none: black image, LEDs or exposure off");
    else if (!find_neighbours(bad, height, width, defect, p->defects, neighbours)) refuse(reason, "image: expected valid pixels in the row or column of each defect, got none");
    else if (!(bytes = write_plan(p, about, about_size, size))) refuse(reason, "no memory is left for the plan");
    free(block);
    return bytes;
}

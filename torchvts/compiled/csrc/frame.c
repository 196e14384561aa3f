/* A frame, from the image to depth, slopes, normals and masks: DepthPipeline of torchvts/pipeline/depth.py in one straight line. */
#include "plan.h"

/* Smallest and largest of n values; NaN where any is none. */
WIDE void range(const float *values, size_t n, float *ends) {
    float low[16], high[16], none[16];
    for (int k = 0; k < 16; k++) low[k] = high[k] = values[0], none[k] = 0.0f;
    for (size_t at = 0; at + 16 <= n; at += 16)
        for (int k = 0; k < 16; k++) {
            const float value = values[at + k];
            low[k] = value < low[k] ? value : low[k], high[k] = value > high[k] ? value : high[k];
            none[k] += 0.0f * value;
        }
    for (size_t at = n - n % 16; at < n; at++)
        low[0] = fminf(low[0], values[at]), high[0] = fmaxf(high[0], values[at]), none[0] += 0.0f * values[at];
    for (int k = 1; k < 16; k++) low[0] = fminf(low[0], low[k]), high[0] = fmaxf(high[0], high[k]), none[0] += none[k];
    ends[0] = low[0] + none[0], ends[1] = high[0] + none[0];
}

/* A frame on its way: compensated image (3, H, W), weight, slopes (2, H, W). */
typedef struct {
    float *light, *weight, *slopes;
} Frame;

static WIDE void times_weight(const float *restrict slopes, const float *restrict weight, size_t n, float *restrict gradient) {
    for (int c = 0; c < 2; c++)
        for (size_t k = 0; k < n; k++) gradient[c * n + k] = slopes[c * n + k] * weight[k];
}

/* Eq. 9, or with a depth eq. 10, and eq. 5: the slopes of a compensated image. */
static void solve_slopes(const Plan *plan, Frame *frame, const float *depth, float *normal) {
    find_normals(plan, frame->light, depth, normal);
    find_slopes(normal, (size_t)plan->height * plan->width, plan->max_slope, frame->slopes);
}

/* Eq. 4: weighted slopes to depth from the undeformed skin. */
static int solve_depth(const Plan *plan, Scratch *scratch, const Frame *frame, float *gradient, float *depth) {
    times_weight(frame->slopes, frame->weight, (size_t)plan->height * plan->width, gradient);
    const int code = integrate(plan, scratch, gradient, depth);
    return code == DONE ? zero_background(plan, scratch, frame->weight, depth) : code;
}

/* Eq. 10: solves again with the depth found, in place. */
static int refine(const Plan *plan, Scratch *scratch, Frame *frame, float *gradient, float *normal, float *depth) {
    int code = DONE;
    for (int pass = 1; code == DONE && pass < plan->passes; pass++) {
        solve_slopes(plan, frame, depth, normal);
        code = solve_depth(plan, scratch, frame, gradient, depth);
    }
    return code;
}

/* gradient_of_depth() of core/geometry.py. */
static WIDE void slopes_of_depth(const float *depth, int height, int width, float per_two, float *gradient) {
    const size_t pixels = (size_t)height * width;
    for (int y = 0; y < height; y++) {
        const float *z = depth + (size_t)y * width, *above = y ? z - width : z, *below = y < height - 1 ? z + width : z;
        const float twice = (y && y < height - 1) || height == 1 ? 1.0f : 2.0f;
        float *p = gradient + (size_t)y * width, *q = p + pixels;
        for (int x = 1; x < width - 1; x++) p[x] = (z[x + 1] - z[x - 1]) * per_two;
        if (width > 1) p[0] = 2.0f * (z[1] - z[0]) * per_two, p[width - 1] = 2.0f * (z[width - 1] - z[width - 2]) * per_two;
        else p[0] = 0.0f;
        for (int x = 0; x < width; x++) q[x] = twice * (below[x] - above[x]) * per_two;
    }
}

static WIDE void normals_of_slopes(const float *restrict gradient, size_t n, float *restrict normal) {
    for (size_t k = 0; k < n; k++) {
        const float p = gradient[k], q = gradient[n + k], n_z = 1.0f / sqrtf(p * p + q * q + 1.0f);
        normal[k] = -p * n_z, normal[n + k] = -q * n_z, normal[2 * n + k] = n_z;
    }
}

/* The output of a frame without moved skin. */
static void undeformed(size_t pixels, float *depth, float *gradient, float *normal, uint8_t *contact, uint8_t *deformed) {
    memset(depth, 0, sizeof(float) * pixels), memset(gradient, 0, 2 * sizeof(float) * pixels);
    memset(normal, 0, 2 * sizeof(float) * pixels);
    for (size_t k = 0; k < pixels; k++) normal[2 * pixels + k] = 1.0f;
    memset(contact, 0, pixels), memset(deformed, 0, pixels);
}

static int any_weight(const float *weight, size_t n) {
    for (size_t k = 0; k < n; k++)
        if (weight[k] > 0.0f) return 1;
    return 0;
}

/* From the image to slopes and weight; conditions: the light (3, 6), what is lost (3), the slope that could not be seen. */
static int begin(const Plan *plan, Scratch *scratch, const float *image, Frame *frame, float *normal, float *conditions) {
    for (int k = 0; k < 22; k++) conditions[k] = k < 18 && k % 6 == 0;
    int code = DONE;
    if (plan->marker_diameter > 0.0) code = fill_markers(plan, scratch, image, normal), image = normal;
    if (plan->light_of) linearise(plan, image, normal), image = normal;
    if (code == DONE) code = compensate(plan, scratch, image, conditions, frame->light);
    if (code != DONE) return code;
    solve_slopes(plan, frame, NULL, normal);
    return weigh(plan, scratch, frame->light, frame->slopes, conditions + 21, frame->weight);
}

/* A frame. image (3, H, W), as the camera gives it; conditions (22), see begin(); depth (1, H, W), gradient (2, H, W), normal
   (3, H, W), contact and deformed (1, H, W) bytes. Returns DONE or NO_MEMORY. */
int reconstruct(const Plan *plan, Scratch *scratch, const float *image, float *conditions, float *depth, float *gradient, float *normal,
                uint8_t *contact, uint8_t *deformed) {
    const size_t pixels = (size_t)plan->height * plan->width, before = scratch->used;
    float *memory = lend(scratch, 6 * sizeof(float) * pixels);
    if (!memory) return NO_MEMORY;
    Frame frame = {memory, memory + 3 * pixels, memory + 4 * pixels};
    int code = begin(plan, scratch, image, &frame, normal, conditions);
    if (code == DONE && !any_weight(frame.weight, pixels)) {
        undeformed(pixels, depth, gradient, normal, contact, deformed);
    } else {
        if (code == DONE) code = solve_depth(plan, scratch, &frame, gradient, depth);
        if (code == DONE) code = refine(plan, scratch, &frame, gradient, normal, depth);
        if (code == DONE) {
            find_moved(plan, frame.weight, depth, deformed);
            code = find_contact(plan, scratch, depth, deformed, contact);
            if (plan->slopes_of_depth) slopes_of_depth(depth, (int)plan->height, (int)plan->width, (float)(0.5 / plan->mm_per_pixel), gradient);
            normals_of_slopes(gradient, pixels, normal);
        }
    }
    give_back(scratch, before);
    return code;
}

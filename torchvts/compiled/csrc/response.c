/* Normals by a response field: torchvts/normals/response.py, which explains them. Along a row each coefficient of the
   field is a polynomial in position, so a row needs a few parameters in place of maps. */
#include "plan.h"

enum { SINGLE = 3, PRODUCTS = 6, CUBES = 10, MOST_TERMS = SINGLE + PRODUCTS + CUBES };

/* One row: sines along x and y from the changes of brightness; weight (degree + 1, 2, terms), highest power last. The terms are the changes,
   their products of two if there are any, and of three. All numbers but n are constants of the callers, so that all loops but one unroll. */
static inline __attribute__((always_inline)) void sines(const float *restrict image, size_t step, const float *restrict place,
                                                        const float *restrict weight, const float *restrict depth,
                                                        const float *restrict per_mm, float steeper, float reference_mm, int degree, int products, int cubes, int n, float *restrict sine_x,
                                                        float *restrict sine_y) {
    const int terms = SINGLE + products + cubes;
    for (int k = 0; k < n; k++) {
        const float u = place[k];
        float term[MOST_TERMS] = {image[k] - 1.0f, image[step + k] - 1.0f, image[2 * step + k] - 1.0f};
        if (depth) {
            const float z = depth[k], deeper = z - reference_mm, by = 1.0f / (steeper * (deeper > 0.0f ? deeper : 0.0f) + 1.0f);
            for (int c = 0; c < 3; c++) term[c] = (term[c] - ((per_mm[3 * c + 2] * u + per_mm[3 * c + 1]) * u + per_mm[3 * c]) * z) * by;
        }
        const float rr = term[0] * term[0], rg = term[0] * term[1], rb = term[0] * term[2];
        const float gg = term[1] * term[1], gb = term[1] * term[2], bb = term[2] * term[2];
        if (products) term[3] = rr, term[4] = rg, term[5] = rb, term[6] = gg, term[7] = gb, term[8] = bb;
        if (cubes) {
            float *cube = term + SINGLE + products;
            cube[0] = rr * term[0], cube[1] = rr * term[1], cube[2] = rr * term[2], cube[3] = rg * term[1], cube[4] = rg * term[2];
            cube[5] = rb * term[2], cube[6] = gg * term[1], cube[7] = gg * term[2], cube[8] = gb * term[2], cube[9] = bb * term[2];
        }
        float x = 0.0f, y = 0.0f;
        UNROLLED for (int power = degree; power >= 0; power--) {
            const float *at = weight + 2 * terms * power;
            float along = at[0] * term[0], down = at[terms] * term[0];
            UNROLLED for (int i = 1; i < terms; i++) along += at[i] * term[i], down += at[terms + i] * term[i];
            x = x * u + along, y = y * u + down;
        }
        sine_x[k] = x, sine_y[k] = y;
    }
}

typedef void (*row_of)(const float *, size_t, const float *, const float *, const float *, const float *, float, float, int, float *, float *);

#define ROW(name, degree, products, cubes)                                                                                               \
    WIDE FUSED static void name(const float *image, size_t step, const float *place, const float *weight, const float *depth,            \
                                const float *per_mm, float steeper, float reference_mm, int n, float *sine_x, float *sine_y) {                    \
        if (depth)                                                                                                                      \
            sines(image, step, place, weight, depth, per_mm, steeper, reference_mm, degree, products, cubes, n, sine_x, sine_y);                                 \
        else                                                                                                                            \
            sines(image, step, place, weight, 0, 0, 0.0f, 0.0f, degree, products, cubes, n, sine_x, sine_y);                                          \
    }

#define ROW_LOOPS(name, products, cubes)      \
    ROW(name##_2, 2, products, cubes)    \
    ROW(name##_4, 4, products, cubes)    \
    ROW(name##_6, 6, products, cubes)

ROW_LOOPS(linear, 0, 0)
ROW_LOOPS(with_products, PRODUCTS, 0)
ROW_LOOPS(with_cubes, 0, CUBES)
ROW_LOOPS(with_both, PRODUCTS, CUBES)

/* By products, 1, and cubes, 2; then by half the degree. */
static const row_of ALL_ROWS[4][3] = {{linear_2, linear_4, linear_6},
                                      {with_products_2, with_products_4, with_products_6},
                                      {with_cubes_2, with_cubes_4, with_cubes_6},
                                      {with_both_2, with_both_4, with_both_6}};

/* Normals of sines, which are held to the largest. */
WIDE static void to_normal(float max_sine, int n, float *restrict x, float *restrict y, float *restrict z) {
    for (int k = 0; k < n; k++) {
        const float squared = x[k] * x[k] + y[k] * y[k], most = max_sine / sqrtf(squared + 1e-12f), kept = most < 1.0f ? most : 1.0f;
        x[k] *= -kept, y[k] *= -kept;
        z[k] = sqrtf(1.0f - squared * (kept * kept));
    }
}

void response_normals(const Plan *plan, const float *light, const float *depth, float *normal) {
    const int terms = (int)plan->terms, degree = (int)plan->degree, width = (int)plan->width;
    const int cubes = terms >= SINGLE + CUBES, products = terms - (cubes ? CUBES : 0) > SINGLE;
    const row_of row = ALL_ROWS[products + 2 * cubes][degree / 2 - 1];
    const size_t pixels = (size_t)plan->height * width;
    for (int y = 0; y < plan->height; y++) {
        const size_t at = (size_t)y * width;
        float *to = normal + at;
        row(light + at, pixels, plan->field_place, plan->field + (size_t)2 * terms * (degree + 1) * y, depth ? depth + at : NULL,
            depth ? plan->per_mm + 9 * y : NULL, (float)plan->steeper, (float)plan->reference_mm, width, to, to + pixels);
        to_normal((float)plan->max_sine, width, to, to + pixels, to + 2 * pixels);
    }
}

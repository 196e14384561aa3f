/* Slopes where a light is blocked or a channel saturated: the same results as torchvts/normals/shadowed.py, which explains them. */
#include "kernels.h"

#include <math.h>

/* The intensity of a channel that is left out, as in torchvts/normals/shadowed.py; no camera gives half of it. */
#define LEFT_OUT -1.0f

/* What does not change from pixel to pixel; the first three are of a frame. */
typedef struct {
    float noise_std, weight, brightness, steps;
    float pitch, per_height, cliff_slope, max_slope;
} Model;

/* Gauss-Newton from slope[2], which it replaces; rows are the light matrix, saturated: channels that are saturated or failed. */
static void fit_slope(const float rows[3][3], const float intensity[3], const int saturated[3], const Model *model, float slope[2]) {
    const float start_p = slope[0], start_q = slope[1], weight = model->weight;
    for (int step = 0; step < (int)model->steps; step++) {
        const float p = slope[0], q = slope[1], n_z = 1.0f / sqrtf(1.0f + p * p + q * q);
        const float normal[3] = {-p * n_z, -q * n_z, n_z};
        float across[3][2], model_light[3], residual[3], energy = 0.0f;
        for (int j = 0; j < 3; j++) {
            const float light = rows[j][0] * normal[0] + rows[j][1] * normal[1] + rows[j][2] * normal[2];
            const float lit = light > 0.1f * model->noise_std && !(saturated[j] && light >= intensity[j]) ? 1.0f : 0.0f;
            for (int i = 0; i < 2; i++) across[j][i] = -n_z * (rows[j][i] - light * normal[i]) * lit;
            model_light[j] = light * lit;
            residual[j] = intensity[j] * lit - model_light[j];
            energy += model_light[j] * model_light[j];
        }
        const float common = (1.0f - 1.0f / sqrtf(1.0f + model->brightness * energy)) / (energy > 1e-12f ? energy : 1e-12f);
        float shared = 0.0f, along[2] = {0.0f, 0.0f};
        for (int j = 0; j < 3; j++) {
            shared += model_light[j] * residual[j];
            for (int i = 0; i < 2; i++) along[i] += model_light[j] * across[j][i];
        }
        float a = weight, b = 0.0f, c = weight, right_p = weight * (start_p - p), right_q = weight * (start_q - q);
        for (int j = 0; j < 3; j++) {
            const float whitened = residual[j] - common * model_light[j] * shared;
            for (int i = 0; i < 2; i++) across[j][i] -= common * model_light[j] * along[i];
            a += across[j][0] * across[j][0];
            b += across[j][0] * across[j][1];
            c += across[j][1] * across[j][1];
            right_p += across[j][0] * whitened;
            right_q += across[j][1] * whitened;
        }
        float squared = 0.0f; /* a c - b^2 without cancellation, by Cauchy and Binet */
        for (int j = 0; j < 3; j++) {
            const int k = (j + 1) % 3;
            const float product = across[j][0] * across[k][1] - across[k][0] * across[j][1];
            squared += product * product;
        }
        const float determinant = squared + weight * (a + c - weight);
        const float step_p = (c * right_p - b * right_q) / determinant, step_q = (a * right_q - b * right_p) / determinant;
        const float length = sqrtf(step_p * step_p + step_q * step_q + 1e-18f), scale = length > 0.5f ? 0.5f / length : 1.0f;
        slope[0] += step_p * scale;
        slope[1] += step_q * scale;
    }
}

/* The mean of two slopes, or the smaller where they are so far apart that a cliff must lie on one side. */
static float slope_beside_cliff(float one, float other, float most) {
    if (fabsf(one - other) < most) return 0.5f * (one + other);
    return fabsf(one) < fabsf(other) ? one : other;
}

/* The slope of the depth at a pixel; one-sided halves at the border. */
static void slope_of_depth(const float *z, int y, int x, int height, int width, const Model *model, float slope[2]) {
    const float left = x > 0 ? z[-1] : *z, right = x < width - 1 ? z[1] : *z;
    const float above = y > 0 ? z[-width] : *z, below = y < height - 1 ? z[width] : *z;
    slope[0] = slope_beside_cliff((*z - left) / model->pitch, (right - *z) / model->pitch, model->cliff_slope);
    slope[1] = slope_beside_cliff((*z - above) / model->pitch, (below - *z) / model->pitch, model->cliff_slope);
}

/*
 * Replaces the normals (frames, 3, height, width) where a light that shines on the flat skin is dark, a channel is saturated, an LED has failed
 * (black in 98 % of the image), or `ill_conditioned` is set, (height, width) bytes. image, depth, three_noises and flat as normals() takes them;
 * weights: (frames, 3), the first three of Model, model_numbers the others; expected: (frames, 2, height, width) or null. With depth, a pixel
 * starts from the slope of the depth; without, from the expected slope or its own normal, or from the flat skin where an LED has failed or the
 * matrix is ill-conditioned.
 */
EXPORT void solve_shadowed(const float *image, const float *three_noises, const float *flat, const float *saturated_above,
                           const uint8_t *ill_conditioned, int frames, int height, int width, const float *depth, const float *expected,
                           const float *position, const float *albedo, const float *model_numbers, const float *weights, float *normal) {
    const size_t pixels = (size_t)height * width;
    for (int b = 0; b < frames; b++, image += 3 * pixels, normal += 3 * pixels, three_noises += 3, weights += 3) {
        const Model model = {weights[0],       weights[1],       weights[2],       model_numbers[0],
                             model_numbers[1], model_numbers[2], model_numbers[3], model_numbers[4]};
        int failed[3], any_failed = 0;
        for (int j = 0; j < 3; j++) {
            size_t count = 0;
            for (size_t k = 0; k < pixels; k++) count += is_dark(image[pixels * j + k], flat[pixels * j + k], three_noises[j]);
            failed[j] = (float)count / (float)pixels > 0.98f;
            any_failed |= failed[j];
        }
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++) {
                const size_t at = (size_t)y * width + x;
                float intensity[3], slope[2], z = 0.0f;
                int saturated[3], wanted = ill_conditioned[at] || any_failed;
                for (int j = 0; j < 3; j++) {
                    const float value = image[pixels * j + at];
                    const int is_saturated = value >= saturated_above[pixels * j + at];
                    wanted |= is_saturated || is_dark(value, flat[pixels * j + at], three_noises[j]);
                    saturated[j] = is_saturated || failed[j] || value <= 0.5f * LEFT_OUT;
                    intensity[j] = failed[j] ? 0.0f : value;
                }
                if (!wanted) continue;
                if (depth) {
                    const float *place = depth + pixels * b + at;
                    z = *place;
                    slope_of_depth(place, y, x, height, width, &model, slope);
                } else if (any_failed || ill_conditioned[at]) {
                    slope[0] = slope[1] = 0.0f;
                } else if (expected) {
                    slope[0] = expected[2 * pixels * b + at];
                    slope[1] = expected[(2 * (size_t)b + 1) * pixels + at];
                } else {
                    const float u = normal[at], v = normal[pixels + at], w = normal[2 * pixels + at];
                    const float steepest = sqrtf(u * u + v * v + 1e-24f) / model.max_slope, up = steepest > w ? steepest : w;
                    slope[0] = -u / up;
                    slope[1] = -v / up;
                }
                const float flat_x = ((float)x - 0.5f * (float)(width - 1)) * model.pitch;
                const float flat_y = ((float)y - 0.5f * (float)(height - 1)) * model.pitch;
                const float see_x = flat_x - flat_x * z * model.per_height, see_y = flat_y - flat_y * z * model.per_height;
                float lights[3][3];
                for (int j = 0; j < 3; j++) {
                    const float to[3] = {position[3 * j] - see_x, position[3 * j + 1] - see_y, position[3 * j + 2] - z};
                    const float squared = to[0] * to[0] + to[1] * to[1] + to[2] * to[2], scale = albedo[j] / (squared * sqrtf(squared));
                    for (int i = 0; i < 3; i++) lights[j][i] = to[i] * scale;
                }
                fit_slope(lights, intensity, saturated, &model, slope);
                const float n_z = 1.0f / sqrtf(slope[0] * slope[0] + slope[1] * slope[1] + 1.0f);
                normal[at] = -slope[0] * n_z, normal[pixels + at] = -slope[1] * n_z, normal[2 * pixels + at] = n_z;
            }
    }
}

/* Slopes where a light is blocked or a channel saturated: torchvts/normals/shadowed.py, which explains them. */
#include "plan.h"

/* What does not change from pixel to pixel. */
typedef struct {
    float noise_std, weight, brightness, steps, pitch, cliff_slope;
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

/* Channels whose LED has failed: dark in nearly all of the image. Returns whether any has. */
static int failed_leds(const Plan *plan, const float *light, int failed[3]) {
    const size_t pixels = (size_t)plan->height * plan->width;
    for (int j = 0; j < 3; j++) {
        size_t count = 0;
        for (size_t k = 0; k < pixels; k++) count += is_dark(light[pixels * j + k], plan->flat_light[pixels * j + k], 3.0f * plan->noise_std[j]);
        failed[j] = (float)count / (float)pixels > (float)plan->failed_share;
    }
    return failed[0] | failed[1] | failed[2];
}

/* The light matrix at a pixel of depth z. */
static void lights_at(const Plan *plan, int y, int x, float z, float rows[3][3]) {
    const float pitch = (float)plan->mm_per_pixel;
    const float see_x = ((float)x - 0.5f * (float)(plan->width - 1)) * pitch, see_y = ((float)y - 0.5f * (float)(plan->height - 1)) * pitch;
    for (int j = 0; j < 3; j++) {
        const float *place = plan->position + 3 * j, to[3] = {place[0] - see_x, place[1] - see_y, place[2] - z};
        const float squared = to[0] * to[0] + to[1] * to[1] + to[2] * to[2], scale = plan->albedo[j] / (squared * sqrtf(squared));
        for (int i = 0; i < 3; i++) rows[j][i] = to[i] * scale;
    }
}

static Model model_of(const Plan *plan) {
    const float *noise = plan->noise_std;
    const float mean = (noise[0] * noise[0] + noise[1] * noise[1] + noise[2] * noise[2]) / 3.0f, std = fmaxf(sqrtf(mean), 1e-6f);
    const float weight = std / (float)plan->prior_std, trust = fmaxf((float)plan->brightness_noises * std, (float)plan->least_brightness) / std;
    return (Model){std, weight * weight, trust * trust, (float)plan->shadow_steps, (float)plan->mm_per_pixel, (float)plan->cliff_slope};
}

/* Replaces normals where a light that shines on the flat skin is dark, a channel is saturated, an LED has failed, or the matrix is ill-conditioned.
   With depth, a pixel starts from the slope of the depth; without, from its own normal, or from the flat skin. */
void solve_shadowed(const Plan *plan, const float *light, const float *depth, float *normal) {
    const int height = (int)plan->height, width = (int)plan->width;
    const size_t pixels = (size_t)height * width;
    const Model model = model_of(plan);
    int failed[3];
    const int any_failed = failed_leds(plan, light, failed);
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            const size_t at = (size_t)y * width + x;
            float intensity[3], slope[2] = {0.0f, 0.0f}, lights[3][3];
            int saturated[3], wanted = plan->ill_conditioned[at] || any_failed;
            for (int j = 0; j < 3; j++) {
                const float value = light[pixels * j + at];
                const int is_saturated = value >= plan->saturated_above[pixels * j + at];
                wanted |= is_saturated || is_dark(value, plan->flat_light[pixels * j + at], 3.0f * plan->noise_std[j]);
                saturated[j] = is_saturated || failed[j];
                intensity[j] = failed[j] ? 0.0f : value;
            }
            if (!wanted) continue;
            if (depth) {
                slope_of_depth(depth + at, y, x, height, width, &model, slope);
            } else if (!any_failed && !plan->ill_conditioned[at]) {
                const float u = normal[at], v = normal[pixels + at], w = normal[2 * pixels + at];
                const float steepest = sqrtf(u * u + v * v + 1e-24f) / (float)plan->start_slope, up = steepest > w ? steepest : w;
                slope[0] = -u / up, slope[1] = -v / up;
            }
            lights_at(plan, y, x, depth ? depth[at] : 0.0f, lights);
            fit_slope(lights, intensity, saturated, &model, slope);
            const float n_z = 1.0f / sqrtf(slope[0] * slope[0] + slope[1] * slope[1] + 1.0f);
            normal[at] = -slope[0] * n_z, normal[pixels + at] = -slope[1] * n_z, normal[2 * pixels + at] = n_z;
        }
}

/* Normals under three near lights: NormalFromIntensity of torchvts/normals/photometric.py and normal_at_depth() of torchvts/model/lights.py, which
   explain them; and the slopes of normals. */
#include "plan.h"

/* One row of normals (3, n) from intensities and the nine rows of the inverse light matrix; channels `plane` and `step` elements apart. */
WIDE static void from_inverse(const float *restrict image, size_t step, const float *restrict inverse, size_t plane, int n,
                              float *restrict x, float *restrict y, float *restrict z) {
    for (int k = 0; k < n; k++) {
        const float r = image[k], g = image[step + k], b = image[2 * step + k];
        const float u = inverse[k] * r + inverse[plane + k] * g + inverse[2 * plane + k] * b;
        const float v = inverse[3 * plane + k] * r + inverse[4 * plane + k] * g + inverse[5 * plane + k] * b;
        const float w = inverse[6 * plane + k] * r + inverse[7 * plane + k] * g + inverse[8 * plane + k] * b;
        const float scale = 1.0f / sqrtf(u * u + v * v + w * w + 1e-24f);
        x[k] = u * scale, y[k] = v * scale, z[k] = w * scale;
    }
}

/* The lights of one call: position and, for each, the six factors of its share of the light. */
typedef struct {
    float place[3][3], table[3][6], plane[3], volume;
} Lights;

/* One row at a known depth, from the place of the first pixel. */
WIDE static void at_depth(const float *restrict image, size_t step, const float *restrict depth, const Lights *restrict lights, float first_x,
                          float y, float pitch, int n, float *restrict nx, float *restrict ny, float *restrict nz) {
    const Lights at = *lights;
    for (int k = 0; k < n; k++) {
        const float z = depth[k], x = first_x + pitch * (float)k;
        float sums[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int j = 0; j < 3; j++) {
            const float a = x - at.place[j][0], b = y - at.place[j][1], c = z - at.place[j][2];
            const float squared = a * a + b * b + c * c, share = image[(size_t)j * step + k] * squared * sqrtf(squared);
            for (int i = 0; i < 6; i++) sums[i] += at.table[j][i] * share;
        }
        const float u = sums[0] - y * sums[5] + z * sums[4], v = sums[1] + x * sums[5] - z * sums[3], w = sums[2] - x * sums[4] + y * sums[3];
        const float volume = at.volume - at.plane[0] * x - at.plane[1] * y - at.plane[2] * z;
        const float sign = volume > 0.0f ? 1.0f : volume < 0.0f ? -1.0f : 0.0f, scale = sign / sqrtf(u * u + v * v + w * w + 1e-24f);
        nx[k] = u * scale, ny[k] = v * scale, nz[k] = w * scale;
    }
}

/* Whether any of n intensities is dark or reaches `saturated`. */
WIDE static int any_invalid(const float *restrict image, const float *restrict flat, float three_noises, const float *restrict saturated, int n) {
    int found = 0;
    for (int k = 0; k < n; k++) found |= is_dark(image[k], flat[k], three_noises) | (image[k] >= saturated[k]);
    return found;
}

static Lights lights_of(const float *position, const float *albedo) {
    Lights lights;
    double at[3][3], cross[3][3], table[3][6], largest = 0.0, squared = 0.0;
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 3; i++) {
            at[j][i] = (double)position[3 * j + i];
            lights.place[j][i] = position[3 * j + i];
            squared += at[j][i] * at[j][i];
        }
    for (int j = 0; j < 3; j++) {
        const double *p = at[(j + 1) % 3], *q = at[(j + 2) % 3];
        for (int i = 0; i < 3; i++) {
            const int k = (i + 1) % 3, l = (i + 2) % 3;
            cross[j][i] = p[k] * q[l] - p[l] * q[k];
            table[j][i] = cross[j][i] / albedo[j];
            table[j][i + 3] = (q[i] - p[i]) / albedo[j];
        }
        for (int i = 0; i < 6; i++)
            if (fabs(table[j][i]) > largest) largest = fabs(table[j][i]);
    }
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 6; i++) lights.table[j][i] = (float)(table[j][i] / (largest * squared * sqrt(squared)));
    for (int i = 0; i < 3; i++) lights.plane[i] = (float)(cross[0][i] + cross[1][i] + cross[2][i]);
    lights.volume = (float)(at[0][0] * cross[0][0] + at[0][1] * cross[0][1] + at[0][2] * cross[0][2]);
    return lights;
}

static void by_lights(const Plan *plan, const float *light, const float *depth, float *normal) {
    const int height = (int)plan->height, width = (int)plan->width;
    const size_t pixels = (size_t)height * width;
    const float pitch = (float)plan->mm_per_pixel;
    int invalid = (int)plan->any_ill_conditioned;
    Lights lights;
    if (depth) lights = lights_of(plan->position, plan->albedo);
    for (int y = 0; y < height; y++) {
        const size_t at = (size_t)y * width;
        float *to = normal + at;
        if (depth)
            at_depth(light + at, pixels, depth + at, &lights, -0.5f * (float)(width - 1) * pitch, ((float)y - 0.5f * (float)(height - 1)) * pitch, pitch,
                     width, to, to + pixels, to + 2 * pixels);
        else
            from_inverse(light + at, pixels, plan->inverse + at, pixels, width, to, to + pixels, to + 2 * pixels);
        for (int c = 0; c < 3; c++)
            invalid |= any_invalid(light + at + pixels * c, plan->flat_light + pixels * c + at, 3.0f * plan->noise_std[c],
                                   plan->saturated_above + pixels * c + at, width);
    }
    if (invalid) solve_shadowed(plan, light, depth, normal);
}

void find_normals(const Plan *plan, const float *light, const float *depth, float *normal) {
    if (plan->by_lights)
        by_lights(plan, light, depth, normal);
    else
        response_normals(plan, light, depth, normal);
}

WIDE static void slope_row(const float *restrict x, const float *restrict y, const float *restrict z, float per_slope, int n,
                           float *restrict p, float *restrict q) {
    for (int k = 0; k < n; k++) {
        const float steepest = sqrtf(x[k] * x[k] + y[k] * y[k] + 1e-24f) * per_slope, scale = -1.0f / (steepest > z[k] ? steepest : z[k]);
        p[k] = x[k] * scale, q[k] = y[k] * scale;
    }
}

void find_slopes(const float *normal, size_t pixels, double max_slope, float *gradient) {
    slope_row(normal, normal + pixels, normal + 2 * pixels, (float)(1.0 / max_slope), (int)pixels, gradient, gradient + pixels);
}

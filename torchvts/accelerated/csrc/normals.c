/* Normals under three near lights: the same numbers as NormalFromIntensity in torchvts/normals/photometric.py and normal_at_depth in
   torchvts/shading.py, which say why. */
#include "kernels.h"

#include <math.h>

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

/* One row at a known depth, from where the first pixel sees the undeformed skin. */
WIDE static void at_depth(const float *restrict image, size_t step, const float *restrict depth, const Lights *restrict lights, float first_x,
                          float row_y, float pitch, float per_height, int n, float *restrict nx, float *restrict ny, float *restrict nz) {
    const Lights at = *lights;
    for (int k = 0; k < n; k++) {
        const float z = depth[k], nearer = z * per_height, rest_x = first_x + pitch * (float)k;
        const float x = rest_x - rest_x * nearer, y = row_y - row_y * nearer;
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

/*
 * Normals (frames, 3, height, width) of images. three_noises (frames, 3). flat, what the lights give on the flat skin, and saturated
 * (3, height, width), inverse (3, 3, height, width). With depth (frames, height, width) the inverse is not needed, but position and albedo of the
 * lights; `per_height` is 1 over the camera's height. Returns whether any light is blocked or channel saturated.
 */
EXPORT int normals(const float *image, const float *three_noises, const float *flat, const float *saturated, const float *inverse, int frames,
                   int height, int width, const float *depth, const float *position, const float *albedo, float pitch, float per_height,
                   float *normal) {
    const size_t pixels = (size_t)height * width;
    int invalid = 0;
    Lights lights;
    if (depth) lights = lights_of(position, albedo);
    for (int b = 0; b < frames; b++)
        for (int y = 0; y < height; y++) {
            const size_t line = (size_t)y * width, at = 3 * pixels * b + line;
            float *to = normal + at;
            if (depth)
                at_depth(image + at, pixels, depth + pixels * b + line, &lights, -0.5f * (float)(width - 1) * pitch,
                         ((float)y - 0.5f * (float)(height - 1)) * pitch, pitch, per_height, width, to, to + pixels, to + 2 * pixels);
            else
                from_inverse(image + at, pixels, inverse + line, pixels, width, to, to + pixels, to + 2 * pixels);
            for (int c = 0; c < 3; c++)
                invalid |= any_invalid(image + at + pixels * c, flat + pixels * c + line, three_noises[3 * b + c], saturated + pixels * c + line, width);
        }
    return invalid;
}

WIDE static void slope_row(const float *restrict x, const float *restrict y, const float *restrict z, float per_slope, int n,
                           float *restrict p, float *restrict q) {
    for (int k = 0; k < n; k++) {
        const float steepest = sqrtf(x[k] * x[k] + y[k] * y[k] + 1e-24f) * per_slope, scale = -1.0f / (steepest > z[k] ? steepest : z[k]);
        p[k] = x[k] * scale, q[k] = y[k] * scale;
    }
}

/* Gradients (frames, 2, pixels) of normals (frames, 3, pixels), no steeper than 1 / per_slope. */
EXPORT void slopes(const float *normal, int frames, int pixels, float per_slope, float *gradient) {
    for (size_t b = 0; b < (size_t)frames; b++) {
        const float *x = normal + 3 * b * pixels;
        slope_row(x, x + pixels, x + 2 * (size_t)pixels, per_slope, pixels, gradient + 2 * b * pixels, gradient + (2 * b + 1) * pixels);
    }
}

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
                          float row_y, float pitch, float per_height, float axis_x, float axis_y, int n, float *restrict nx,
                          float *restrict ny, float *restrict nz) {
    const Lights at = *lights;
    for (int k = 0; k < n; k++) {
        const float z = depth[k], nearer = z * per_height, rest_x = first_x + pitch * (float)k;
        const float x = rest_x - (rest_x - axis_x) * nearer, y = row_y - (row_y - axis_y) * nearer;
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

/* The lights from where (-axis_x, -axis_y) is the origin. */
static Lights lights_of(const float *position, const float *albedo, float axis_x, float axis_y) {
    Lights lights;
    double at[3][3], cross[3][3], table[3][6], largest = 0.0, squared = 0.0;
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 3; i++) {
            at[j][i] = (double)position[3 * j + i] + (i == 0 ? axis_x : i == 1 ? axis_y : 0.0f);
            lights.place[j][i] = (float)at[j][i];
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
 * Normals (frames, 3, rows, columns) of a window of an image. image (frames, 3, rows, columns), frames, channels and rows `per_frame`,
 * `per_channel` and `per_row` elements apart. three_noises (frames, 3). flat, what the lights give on the flat skin, and saturated
 * (3, height, width) and the inverse (3, 3, height, width) from the window's first pixel on, their rows `width` and planes `plane`
 * elements apart. With depth, of the window, rows and frames `depth_row` and `depth_frame` elements apart, the inverse is not needed, but position and
 * albedo of the lights, and where the middle of the image lies as seen from that of the window (axis_x, axis_y), mm; `per_height` is 1 over
 * the camera's height.
 * Returns whether any light is blocked or channel saturated.
 */
EXPORT int normals(const float *image, int64_t per_frame, int64_t per_channel, int64_t per_row, const float *three_noises, const float *flat,
                   const float *saturated, const float *inverse, int64_t plane, int width, int frames, int rows, int columns, const float *depth,
                   int64_t depth_frame, int64_t depth_row, const float *position, const float *albedo, float pitch, float per_height,
                   float axis_x, float axis_y, float *normal) {
    const size_t pixels = (size_t)rows * columns;
    int invalid = 0;
    Lights lights;
    if (depth) lights = lights_of(position, albedo, axis_x, axis_y);
    for (int b = 0; b < frames; b++)
        for (int y = 0; y < rows; y++) {
            const float *row = image + per_frame * b + per_row * y;
            const size_t at = (size_t)y * width;
            float *to = normal + 3 * pixels * b + (size_t)y * columns;
            if (depth)
                at_depth(row, (size_t)per_channel, depth + depth_frame * b + depth_row * y, &lights, -0.5f * (float)(columns - 1) * pitch,
                         ((float)y - 0.5f * (float)(rows - 1)) * pitch, pitch, per_height, axis_x, axis_y, columns, to, to + pixels,
                         to + 2 * pixels);
            else
                from_inverse(row, (size_t)per_channel, inverse + at, (size_t)plane, columns, to, to + pixels, to + 2 * pixels);
            for (int c = 0; c < 3; c++)
                invalid |= any_invalid(row + per_channel * c, flat + plane * c + at, three_noises[3 * b + c], saturated + plane * c + at, columns);
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

WIDE static void normal_row(const float *restrict p, const float *restrict q, int n, float *restrict x, float *restrict y,
                            float *restrict z) {
    for (int k = 0; k < n; k++) {
        const float scale = 1.0f / sqrtf(p[k] * p[k] + q[k] * q[k] + 1.0f);
        x[k] = -p[k] * scale, y[k] = -q[k] * scale, z[k] = scale;
    }
}

WIDE static void fill(float *values, float value, size_t n) {
    if (value == 0.0f)
        memset(values, 0, sizeof(float) * n);
    else
        for (size_t k = 0; k < n; k++) values[k] = value;
}

/* Rows `first` to `last` of the whole image; contact, where there is any. */
void rows_uncropped(const Uncropping *of, int first, int last) {
    const int width = of->width, columns = of->columns, left = of->left;
    const size_t pixels = (size_t)of->height * width, part = (size_t)of->rows * columns, right = (size_t)(width - left - columns);
    float *planes[5] = {of->whole, of->whole + pixels, of->normal, of->normal + pixels, of->normal + 2 * pixels};
    for (int line = first; line < last; line++) {
        const size_t at = (size_t)line * width;
        const int y = line - of->top;
        const int inside = y >= 0 && y < of->rows;
        for (int k = 0; k < 5; k++) {
            const float value = k < 4 ? 0.0f : 1.0f;
            fill(planes[k] + at, value, inside ? (size_t)left : (size_t)width);
            if (inside) fill(planes[k] + at + left + columns, value, right);
        }
        memset(of->touching + at, 0, (size_t)width);
        if (!inside) continue;
        const float *p = of->gradient + (size_t)y * columns, *q = p + part;
        memcpy(of->whole + at + left, p, sizeof(float) * (size_t)columns);
        memcpy(of->whole + pixels + at + left, q, sizeof(float) * (size_t)columns);
        if (of->contact) memcpy(of->touching + at + left, of->contact + (size_t)y * columns, (size_t)columns);
        normal_row(p, q, columns, planes[2] + at + left, planes[3] + at + left, planes[4] + at + left);
    }
}

static void uncrop_band(void *with, int band) {
    const Uncropping *of = with;
    const int bands = bands_of(of->height);
    rows_uncropped(of, of->height * band / bands, of->height * (band + 1) / bands);
}

/* The gradient of a window (frames, 2, rows, columns) at (top, left) and its contact (bytes) set into the whole image, zero elsewhere, and the
   normals. */
EXPORT void uncrop(const float *gradient, const uint8_t *contact, int frames, int rows, int columns, int top, int left, int height, int width,
                   float *whole, float *normal, uint8_t *touching) {
    const size_t pixels = (size_t)height * width, part = (size_t)rows * columns;
    for (size_t b = 0; b < (size_t)frames; b++) {
        Uncropping work = {gradient + 2 * part * b, contact + part * b, rows, columns, top, left, height, width, whole + 2 * pixels * b,
                           normal + 3 * pixels * b, touching + pixels * b};
        share(uncrop_band, &work, bands_of(height));
    }
}

/* top, bottom, left, right of the smallest box that holds all bytes that are not zero, of all frames; zeros without any. */
EXPORT void box_of(const uint8_t *mask, int frames, int height, int width, int *box) {
    box[0] = height, box[1] = 0, box[2] = width, box[3] = 0;
    for (int y = 0; y < height * frames; y++) {
        const uint8_t *row = mask + (size_t)y * width;
        const int line = y % height;
        const int first = bytes_alike(row, width, 0);
        int last = width;
        if (first == width) continue;
        while (last - 64 > box[3] && bytes_alike(row + last - 64, 64, 0) == 64) last -= 64;
        while (last > box[3] && !row[last - 1]) last--;
        box[0] = least(box[0], line), box[1] = line + 1 > box[1] ? line + 1 : box[1];
        box[2] = least(box[2], first), box[3] = last > box[3] ? last : box[3];
    }
    if (box[1] == 0) box[0] = box[2] = 0;
}

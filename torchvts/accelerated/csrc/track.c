/* Sums of one Gauss-Newton step of a tracked pose: the same results as torchvts/pose/inverse.py, which explains them. */
#include "kernels.h"

#define PLACES 8
#define BLOCK 64

/* The four channels z, p, q, mask of a field at a place between pixels. */
static inline void between(const float *field, int height, int width, float row, float column, float *found) {
    const int top = least((int)row, height - 2), left = least((int)column, width - 2);
    const float down = row - (float)top, along = column - (float)left;
    const float *upper = field + 4 * ((size_t)top * width + left), *lower = upper + 4 * (size_t)width;
    const float a = (1.0f - down) * (1.0f - along), b = (1.0f - down) * along, c = down * (1.0f - along), d = down * along;
    for (int k = 0; k < 4; k++) found[k] = a * upper[k] + b * upper[k + 4] + c * lower[k] + d * lower[k + 4];
}

/* field (height, width, 4); pixels (count, 32): x, y, z, p, q, three zeros, then the rows of p, q, z of the Jacobian, each of six and
   two zeros; numbers: see sum_residuals in inverse.py; sums: 7 x 8 of the products, then seven of the score. */
EXPORT WIDE void alignment_sums(
    const float *field, int height, int width, const float *pixels, int count, const double *numbers, double *sums) {
    float R[9], t[3];
    for (int k = 0; k < 9; k++) R[k] = (float)numbers[k];
    for (int k = 0; k < 3; k++) t[k] = (float)numbers[9 + k];
    const float x0 = (float)numbers[12], y0 = (float)numbers[13], per_mm = (float)(1.0 / numbers[14]);
    const float per_slope = (float)numbers[15], per_height = (float)numbers[16]; /* 1 / noise^2 */
    const float score_slope = (float)numbers[17], score_height = (float)numbers[18], deep = (float)numbers[19];
    const float shallow = (float)numbers[20];
    memset(sums, 0, (7 * PLACES + 7) * sizeof(double));
    double *score = sums + 7 * PLACES;
    for (int first = 0; first < count; first += BLOCK) {
        float total[7][PLACES] = {{0.0f}};
        for (int n = first; n < least(first + BLOCK, count); n++) {
            const float *pixel = pixels + (size_t)32 * n;
            const float x = pixel[0], y = pixel[1], z = pixel[2];
            const float moved_z = R[6] * x + R[7] * y + R[8] * z + t[2];
            const float column = (R[0] * x + R[1] * y + R[2] * z + t[0] - x0) * per_mm;
            const float row = (y0 - (R[3] * x + R[4] * y + R[5] * z + t[1])) * per_mm;
            if (!(column >= 0.0f && column <= (float)(width - 1) && row >= 0.0f && row <= (float)(height - 1))) continue;
            float found[4];
            between(field, height, width, row, column, found);
            const int inside = found[3] > 0.999f, near = found[3] > 0.001f;
            const float p = found[1], q = found[2];
            const float up = R[8] - R[2] * p - R[5] * q, steep = 1.0f / (up > 0.05f ? up : 0.05f);
            const float off_p = (R[0] * p + R[3] * q - R[6]) * steep - pixel[3];
            const float off_q = (R[1] * p + R[4] * q - R[7]) * steep - pixel[4];
            const float off_z = found[0] - moved_z;
            const float off = off_p * off_p + off_q * off_q, high = off_z * off_z;
            if (moved_z > deep && (inside || !near)) {
                const float error = inside ? off * score_slope + high * score_height : 1.0f;
                score[4] += error < 1.0f ? error : 1.0f;
                score[5] += error < 1.0f;
                score[6] += 1.0;
            }
            if (!inside || moved_z <= shallow) continue;
            const float weight = 1.0f / (1.0f + 0.25f * (off * per_slope + high * per_height));
            score[0] += 1.0, score[1] += weight, score[2] += weight * off, score[3] += weight * high;
            for (int r = 0; r < 3; r++) {
                float line[PLACES];
                for (int k = 0; k < PLACES; k++) line[k] = pixel[8 + PLACES * r + k];
                line[6] = r == 0 ? off_p : r == 1 ? off_q : off_z;
                const float scale = weight * (r < 2 ? per_slope : per_height);
                for (int i = 0; i < 7; i++)
                    for (int k = 0; k < PLACES; k++) total[i][k] += scale * line[i] * line[k];
            }
        }
        for (int i = 0; i < 7; i++)
            for (int k = 0; k < PLACES; k++) sums[PLACES * i + k] += (double)total[i][k];
    }
}

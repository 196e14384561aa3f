/* Sums of one Gauss-Newton step of a tracked pose: the same results as torchvts/pose/inverse.py, which explains them. */
#include "kernels.h"

#define PLACES 8
#define LINES 3
#define FIRST 8 /* of a pixel's Jacobian; before it: x, y, z, p, q */
#define PIXEL 32
#define BLOCK 64 /* pixels that are summed in float32 */

typedef float Line __attribute__((vector_size(4 * PLACES), aligned(4)));

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
    const float shallow = (float)numbers[20], last_column = (float)(width - 1), last_row = (float)(height - 1);
    float used = 0.0f, weights = 0.0f, slopes = 0.0f, heights = 0.0f, bad = 0.0f, good = 0.0f, compared = 0.0f;
    Line total[PLACES - 1];
    memset(sums, 0, 7 * PLACES * sizeof(double));
    memset(total, 0, sizeof(total));
    for (int n = 0; n < count; n++) {
        const float *pixel = pixels + (size_t)PIXEL * n;
        const float x = pixel[0], y = pixel[1], z = pixel[2];
        const float moved_z = R[6] * x + R[7] * y + R[8] * z + t[2];
        const float column = (R[0] * x + R[1] * y + R[2] * z + t[0] - x0) * per_mm;
        const float row = (y0 - (R[3] * x + R[4] * y + R[5] * z + t[1])) * per_mm;
        if (column >= 0.0f && column <= last_column && row >= 0.0f && row <= last_row && moved_z > shallow) {
            const int top = least((int)row, height - 2), left = least((int)column, width - 2);
            const float down = row - (float)top, along = column - (float)left;
            const float *upper = field + 4 * ((size_t)top * width + left), *lower = upper + 4 * (size_t)width;
            float found[4]; /* z, p, q, mask between pixels */
            for (int k = 0; k < 4; k++) {
                const float a = upper[k] + along * (upper[k + 4] - upper[k]), b = lower[k] + along * (lower[k + 4] - lower[k]);
                found[k] = a + down * (b - a);
            }
            const int inside = found[3] > 0.999f;
            const float p = found[1], q = found[2];
            const float up = R[8] - R[2] * p - R[5] * q, steep = 1.0f / (up > 0.05f ? up : 0.05f);
            const float off_p = (R[0] * p + R[3] * q - R[6]) * steep - pixel[3];
            const float off_q = (R[1] * p + R[4] * q - R[7]) * steep - pixel[4];
            const float off_z = found[0] - moved_z;
            const float off = off_p * off_p + off_q * off_q, high = off_z * off_z;
            if (moved_z > deep && (inside || found[3] <= 0.001f)) {
                const float error = inside ? off * score_slope + high * score_height : 1.0f;
                bad += error < 1.0f ? error : 1.0f, good += error < 1.0f ? 1.0f : 0.0f, compared += 1.0f;
            }
            if (inside) {
                const float weight = 1.0f / (1.0f + 0.25f * (off * per_slope + high * per_height));
                used += 1.0f, weights += weight, slopes += weight * off, heights += weight * high;
                const float residual[LINES] = {off_p, off_q, off_z};
                for (int r = 0; r < LINES; r++) {
                    Line line = *(const Line *)(pixel + FIRST + PLACES * r);
                    line[6] = residual[r];
                    const Line scaled = line * (weight * (r < 2 ? per_slope : per_height));
                    for (int i = 0; i < PLACES - 1; i++) total[i] += scaled[i] * line;
                }
            }
        }
        if (n % BLOCK == BLOCK - 1 || n == count - 1) {
            for (int i = 0; i < PLACES - 1; i++)
                for (int k = 0; k < PLACES; k++) sums[PLACES * i + k] += (double)total[i][k];
            memset(total, 0, sizeof(total));
        }
    }
    const float score[7] = {used, weights, slopes, heights, bad, good, compared};
    for (int k = 0; k < 7; k++) sums[7 * PLACES + k] = (double)score[k];
}

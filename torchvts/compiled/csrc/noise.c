/* Noise of a frame: torchvts/core/noise.py, which explains it. */
#include "plan.h"

#include <float.h>
#include <stdlib.h>

/* The k-th smallest of n values, which it reorders, by Hoare's selection; or what is no number if one of them is none. */
static float kth_smallest(float *values, int n, int k) {
    int low = 0, high = n - 1;
    for (int i = 0; i < n; i++)
        if (!(values[i] <= FLT_MAX)) return NAN;
    while (low < high) {
        float pivot = values[low + (high - low) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot) i++;
            while (values[j] > pivot) j--;
            if (i <= j) {
                float swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            break;
    }
    return values[k];
}

enum { LANES = 16 };

/* Standard deviation of the values within three standard deviations; in double, so that the order of the sums leaves no trace. */
WIDE static float clipped_std(const float *restrict values, int n, float std) {
    double totals[LANES] = {0.0}, total = 0.0;
    const float most = 3.0f * std;
    int counts[LANES] = {0}, count = 0, k = 0;
    for (; k + LANES <= n; k += LANES)
        for (int j = 0; j < LANES; j++) {
            const float value = values[k + j];
            totals[j] += (double)(value <= most ? value * value : 0.0f);
            counts[j] += value <= most;
        }
    for (; k < n; k++) {
        total += (double)(values[k] <= most ? values[k] * values[k] : 0.0f);
        count += values[k] <= most;
    }
    for (int j = 0; j < LANES; j++) total += totals[j], count += counts[j];
    return (float)sqrt(total / (double)(count > 0 ? count : 1) / 0.97334);
}

/* noise_from() of torchvts/core/noise.py, of the n second differences `some`. */
static float noise_from(const float *some, int n, float std) {
    std *= 1.5f;
    for (int pass = 0; pass < 2 && std == std; pass++) std = clipped_std(some, n, std);
    return std / sqrtf(1.5f);
}

/* noise_of_spotted() of noise.py, or the calibrated noise where that is larger. */
int measure_noise(const Plan *plan, const float *light, float *noise) {
    const int height = (int)plan->height, width = (int)plan->width, stride = (int)plan->noise_stride;
    const size_t samples = (size_t)((height + stride - 1) / stride) * ((width + stride - 1) / stride);
    float *some = malloc(2 * sizeof(float) * samples);
    if (!some) return NO_MEMORY;
    for (int c = 0; c < 3; c++, light += (size_t)height * width) {
        int n = 0;
        for (int y = stride / 2; y < height; y += stride)
            for (int x = 0; x < width - 2; x += stride) {
                const float *at = light + (size_t)y * width + x;
                some[n++] = fabsf(at[1] - 0.5f * (at[0] + at[2]));
            }
        noise[c] = plan->noise_std[c];
        if (n == 0) continue;
        memcpy(some + n, some, sizeof(float) * (size_t)n);
        const float found = noise_from(some, n, kth_smallest(some + n, n, n / 4) / 0.3186f);
        noise[c] = found > noise[c] ? found : noise[c];
    }
    free(some);
    return DONE;
}

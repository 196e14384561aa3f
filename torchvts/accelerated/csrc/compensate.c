/* Samples of compensated images: the same results as torchvts/compensate/drift.py. */
#include "kernels.h"

/* Means of 3 x 3 pixels, the first from (first, first) on and then every `stride`, of `planes` images: (planes, rows, columns). */
EXPORT void grid_means(const float *image, int planes, int height, int width, int stride, int first, int rows, int columns, float *means) {
    for (int plane = 0; plane < planes; plane++, image += (size_t)height * width)
        for (int i = 0; i < rows; i++)
            for (int j = 0; j < columns; j++) {
                const float *a = image + (size_t)(first + i * stride) * width + first + j * stride, *b = a + width, *c = b + width;
                *means++ = (a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + c[0] + c[1] + c[2]) / 9.0f;
            }
}

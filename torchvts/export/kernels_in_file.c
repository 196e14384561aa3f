/* The operator of an AOTInductor file that holds the compiled kernels: torchvts/export/kernels_in_file.py says what `pieces` are. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Of torch's stable C interface, torch/csrc/inductor/aoti_torch/c/shim.h. */
typedef void *Tensor;
int32_t aoti_torch_get_data_ptr(Tensor, void **);
int32_t aoti_torch_get_dim(Tensor, int64_t *);
int32_t aoti_torch_get_dtype(Tensor, int32_t *);
int32_t aoti_torch_get_numel(Tensor, int64_t *);
int32_t aoti_torch_get_size(Tensor, int64_t, int64_t *);
int32_t aoti_torch_get_stride(Tensor, int64_t, int64_t *);
int32_t aoti_torch_dtype_float32(void);
int32_t aoti_torch_dtype_bool(void);
int32_t aoti_torch_device_type_cpu(void);
int32_t aoti_torch_empty_strided(int64_t, const int64_t *, const int64_t *, int32_t, int32_t, int32_t, Tensor *);

/* Of torchvts/accelerated/csrc/frame.c, whose Program begins with height and width. */
int solve_frames(const void *program, const float *images, int frames, int threads, float *depth, float *gradient, float *normal, uint8_t *contact,
                 uint8_t *deformed);

enum { MOST_STRUCTURES = 8, OUTPUTS = 5 };

/* Pixels of a batch up to which one thread does all, as in torchvts/accelerated/threads.py. */
static const int64_t MOST_PIXELS = 640 * 480;

static int32_t refuse(const char *why) {
    fprintf(stderr, "torchvts: %s\n", why);
    return 1;
}

static void *data_of(Tensor tensor) {
    void *data = NULL;
    return aoti_torch_get_data_ptr(tensor, &data) ? NULL : data;
}

/* Copies of the structures with the addresses of what they point to, the program first. Returns how many, 0 where there is no memory. */
static int structures_of(const Tensor *pieces, void **copies) {
    int64_t numbers = 0;
    aoti_torch_get_numel(pieces[0], &numbers);
    const int64_t *at = data_of(pieces[0]), *end = at + numbers / (int64_t)sizeof(int64_t);
    const int count = (int)*at++;
    for (int k = 0; k < count; k++) {
        int64_t bytes = 0;
        aoti_torch_get_numel(pieces[1 + k], &bytes);
        copies[k] = malloc((size_t)bytes);
        if (!copies[k]) {
            while (k) free(copies[--k]);
            return 0;
        }
        memcpy(copies[k], data_of(pieces[1 + k]), (size_t)bytes);
    }
    for (; at < end; at += 3) {
        void *address = at[2] < count ? copies[at[2]] : data_of(pieces[1 + at[2]]);
        memcpy((char *)copies[at[0]] + at[1], &address, sizeof address);
    }
    return count;
}

/* Images with their values one after the other, in memory to be freed, whatever their strides are. */
static float *contiguous(const float *images, const int64_t *size, const int64_t *stride) {
    float *copy = malloc(sizeof(float) * (size_t)(size[0] * size[1] * size[2] * size[3])), *to = copy;
    if (!copy) return NULL;
    for (int64_t b = 0; b < size[0]; b++)
        for (int64_t c = 0; c < size[1]; c++)
            for (int64_t y = 0; y < size[2]; y++) {
                const float *row = images + b * stride[0] + c * stride[1] + y * stride[2];
                for (int64_t x = 0; x < size[3]; x++) *to++ = row[x * stride[3]];
            }
    return copy;
}

/* Depth, gradient, normal, contact and deformed of images that lie one after the other. Returns the bits of solve_frames(). */
static int solve_all(const void *program, const float *images, int64_t frames, int64_t pixels, void *const *out) {
    int trouble = 0;
#pragma omp parallel for reduction(| : trouble) if (frames * pixels > MOST_PIXELS)
    for (int64_t b = 0; b < frames; b++) {
        const int64_t at = b * pixels;
        trouble |= solve_frames(program, images + 3 * at, 1, 1, (float *)out[0] + at, (float *)out[1] + 2 * at, (float *)out[2] + 3 * at,
                                (uint8_t *)out[3] + at, (uint8_t *)out[4] + at);
    }
    return trouble;
}

static int32_t new_outputs(const int64_t *size, Tensor *const *outputs, void **data) {
    static const int64_t channels[OUTPUTS] = {1, 2, 3, 1, 1};
    for (int k = 0; k < OUTPUTS; k++) {
        const int64_t shape[4] = {size[0], channels[k], size[2], size[3]};
        const int64_t strides[4] = {channels[k] * size[2] * size[3], size[2] * size[3], size[3], 1};
        const int32_t dtype = k < 3 ? aoti_torch_dtype_float32() : aoti_torch_dtype_bool();
        if (aoti_torch_empty_strided(4, shape, strides, dtype, aoti_torch_device_type_cpu(), 0, outputs[k])) return 1;
        data[k] = data_of(*outputs[k]);
    }
    return 0;
}

/* What the file calls. Returns 0, or 1, which becomes an exception; the reason is then on stderr. */
int32_t aoti_torch_cpu_solve_frames(Tensor images, const Tensor *pieces, int64_t count, Tensor *depth, Tensor *gradient, Tensor *normal, Tensor *contact,
                                    Tensor *deformed) {
    int64_t size[4], stride[4], dimensions = 0;
    int32_t dtype = -1, known[2];
    (void)count;
    memcpy(known, data_of(pieces[1]), sizeof known);
    if (aoti_torch_get_dim(images, &dimensions) || aoti_torch_get_dtype(images, &dtype)) return 1;
    for (int k = 0; k < 4 && dimensions == 4; k++)
        if (aoti_torch_get_size(images, k, &size[k]) || aoti_torch_get_stride(images, k, &stride[k])) return 1;
    if (dimensions != 4 || size[1] != 3 || size[2] != known[0] || size[3] != known[1] || dtype != aoti_torch_dtype_float32())
        return refuse("images: expected float32 (B, 3, H, W) of the calibration's size");
    void *data[OUTPUTS], *structures[MOST_STRUCTURES];
    Tensor *const outputs[OUTPUTS] = {depth, gradient, normal, contact, deformed};
    if (new_outputs(size, outputs, data)) return 1;
    const int64_t pixels = size[2] * size[3];
    const int whole = stride[3] == 1 && stride[2] == size[3] && stride[1] == pixels && (size[0] < 2 || stride[0] == 3 * pixels);
    float *copy = whole ? NULL : contiguous(data_of(images), size, stride);
    const int made = whole || copy ? structures_of(pieces, structures) : 0;
    const int trouble = made ? solve_all(structures[0], whole ? data_of(images) : copy, size[0], pixels, data) : 1;
    for (int k = 0; k < made; k++) free(structures[k]);
    free(copy);
    if (trouble & 1) return refuse("no memory is left for a frame");
    return trouble ? refuse("images: expected values in [0, 1]: divide 8-bit values by 255") : 0;
}

/* What the sources of this folder share. All arrays are float32 unless stated otherwise, rows contiguous. */
#ifndef TORCHVTS_KERNELS_H
#define TORCHVTS_KERNELS_H

#include <math.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(__SSE__)
#include <xmmintrin.h>
#endif

#if defined(EXPORT) /* given by who links the kernels into something else */
#elif defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Loops that the compiler vectorises are built once per kind of processor; the loader of the library picks. */
#if defined(WIDE)
#elif defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define WIDE
#endif

/* Products and sums rounded once, where the processor can, as torch's own loops do for some operators. */
#if defined(__GNUC__) && !defined(__clang__)
#define FUSED __attribute__((optimize("fp-contract=fast")))
#else
#define FUSED
#endif

/* Before a loop whose turns touch different places, and one of a few turns within another that is to be vectorised. */
#if defined(__clang__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#define UNROLLED _Pragma("unroll")
#elif defined(__GNUC__)
#define INDEPENDENT _Pragma("GCC ivdep")
#define UNROLLED _Pragma("GCC unroll 32")
#else
#define INDEPENDENT
#define UNROLLED
#endif

/* Has the processor fetch a line of memory that will be read soon. */
#if defined(__GNUC__)
#define FETCH(address) __builtin_prefetch(address)
#else
#define FETCH(address) (void)(address)
#endif

/* Memory that the library keeps from call to call, in place of the system's: see memory.c. */
void *kept_memory(size_t size);
void *kept_zeros(size_t count, size_t size);
void give_back(void *memory);

#ifndef TORCHVTS_MEMORY
#define malloc(size) kept_memory(size)
#define calloc(count, size) kept_zeros(count, size)
#define free(memory) give_back(memory)
#endif

/* Work in parts, numbered from 0, that threads take in turn: see threads.c. */
typedef void (*PartOfWork)(void *with, int part);
int begin_sharing(int threads);
void end_sharing(int began);
void share(PartOfWork work, void *with, int parts);
void offer(PartOfWork work, void *with, int parts);
void join_in(int threads);
void withdraw(void);

/* How a smooth change of the light is found in images of a size: see torchvts/core/smooth.py. place: (6, samples), the surface's terms at rows * columns samples,
   then zeros up to a multiple of 16; along_x (2, width), along_y (2, height): Legendre polynomials of degree 1 and 2; per_square: of each step. */
typedef struct {
    int32_t height, width, stride, rows, columns, samples, steps;
    double most;
    const double *place;
    const float *along_x, *along_y;
    const double *per_square, *peaks;
} SmoothLight;

EXPORT void grid_means(const float *image, int planes, int height, int width, int stride, int first, int rows, int columns, float *means);
EXPORT int smooth_change(const SmoothLight *of, const float *image, int frames, float *found);
EXPORT void over_smooth(const SmoothLight *of, const float *image, const float *found, int frames, float *result);

/* The surface along a row: its terms of degree 0 to 2 in x. */
typedef struct {
    float constant, once, twice;
} LightOfRow;

LightOfRow light_of_row(const SmoothLight *of, const float *found, int y);

/* A value without the surface, where Legendre polynomials in x are `once` and `twice`. */
static inline float without_light(LightOfRow of, float value, float once, float twice) {
    const float surface = of.constant + of.once * once + of.twice * twice;
    return value * (1.0f - surface + surface * surface);
}

void row_over_smooth(const SmoothLight *of, const float *found, int y, int first, int n, const float *values, float *result);

/* How the levels of the light are found: Drift.by_mode() of torchvts/compensate/drift.py. */
typedef struct {
    int stride, halvings;
    float least_drift, most_drift;
} Leveling;

/* Every stride-th pixel of an image, of which the modes of its planes are sought. */
typedef struct {
    const float *image;
    int height, width, stride, halvings;
    float *mode;
    atomic_int short_of_memory;
} Modes;

/* An image to be cleaned: what clean() of compensate.c is given, the bits of what it returns, and in how many parts it is done. */
typedef struct {
    const float *image, *gain, *offset, *pedestal;
    const int64_t *defect, *neighbours;
    int64_t defects;
    const float *weight;
    int taps, height, width, bands, parts;
    float *light;
    Modes modes; /* of what is cleaned, where `leveling` is given */
    const Leveling *leveling;
    atomic_int trouble, left[3]; /* bands of each plane that are not done yet */
} Cleaning;

/* What frame.c calls of the other sources, which say what these do. */
void prepare_cleaning(Cleaning *work, const float *image, const float *gain, const float *offset, const float *pedestal, const int64_t *defect,
                      const int64_t *neighbours, int64_t defects, const float *weight, int taps, int height, int width, float *light,
                      const Leveling *leveling, float *level);
void clean_band(void *with, int part);
int cleaned(Cleaning *work);
EXPORT int clean(const float *image, const float *gain, const float *offset, const float *pedestal, const int64_t *defect, const int64_t *neighbours,
                 int64_t defects, const float *weight, int taps, int frames, int height, int width, float *light,
                 const Leveling *leveling, float *level);
EXPORT void divide_planes(const float *image, const float *level, int planes, int64_t n, float *result);
EXPORT int contact_mask(const float *image, const float *divided, const float *offset, const float *per_noise, const float *failed_below,
                        const float *most_far_field, int frames, int height, int width, int step, int stride, int cell, int reach, float sigmas,
                        float rounding, float least_cells, int bridge, float bridge_sigmas, float tail_sigmas, float least_spread,
                        float least_colour, const SmoothLight *smooth, float *surface, uint8_t *mask, uint8_t *inner, uint8_t *tail);
EXPORT void box_of(const uint8_t *mask, int frames, int height, int width, int *box);
EXPORT void response_normals(const float *image, int64_t per_frame, int64_t per_channel, int64_t per_row, const float *place, const float *weight,
                             int degree, int terms, const float *depth, int64_t depth_frame, int64_t depth_row, const float *per_mm, float steeper,
                             float reference_mm, float max_sine, int frames, int rows, int columns, float *normal);
EXPORT int normals(const float *image, int64_t per_frame, int64_t per_channel, int64_t per_row, const float *three_noises, const float *flat,
                   const float *saturated, const float *inverse, int64_t plane, int width, int frames, int rows, int columns, const float *depth,
                   int64_t depth_frame, int64_t depth_row, const float *position, const float *albedo, float pitch, float per_height, float axis_x,
                   float axis_y, float *normal);
EXPORT void slopes(const float *normal, int frames, int pixels, float per_slope, float *gradient);
EXPORT void mask_values(const float *values, const uint8_t *mask, int64_t per_frame, int64_t per_row, int frames, int channels, int rows,
                        int columns, float *masked);
EXPORT int solve_poisson(const float *gradient, const double *tables, float mm_per_pixel, int frames, int rows, int columns, int top, int left,
                         int height, int width, int zeroed, float *depth);
EXPORT int zero_background(const float *depth, const uint8_t *deformed, int frames, int height, int width, float stiff, float tolerance,
                           int sweeps, float *out);
int zero_frame(const float *depth, const uint8_t *deformed, int height, int width, float stiff, float tolerance, int sweeps, const float *ends,
               float *out);
int add_faces(const float *depth, uint8_t *deformed, int height, int width, uint8_t *kind, float ends[2]);
EXPORT void depth_slopes(const float *depth, int64_t depth_frame, int64_t depth_row, const uint8_t *mask, int64_t mask_frame, int64_t mask_row,
                         float half_per_mm, int frames, int rows, int columns, float *gradient);
void range_of(const float *values, size_t n, float *lowest, float *highest);

/* Depth that pressure is looked for in: that above an edge, not below `least`. */
typedef struct {
    float depth, least;
} Edge;

static const Edge NO_EDGE = {0.0f, -INFINITY};

static inline float above_edge(Edge edge, float depth) {
    const float above = depth - edge.depth;
    return above > edge.least ? above : edge.least;
}

/* What find_contact() is given: settings of ContactFromDepth, a window of depth and deformed skin (bytes) whose rows lie at the given distances, and its
   gradient (2, rows, columns). Contact goes to bytes, rows too at a distance. beside(with, part): so many parts of other work, which wait for
   nothing of this. */
typedef struct {
    const float *depth, *gradient, *numbers;
    const uint8_t *deformed;
    int64_t depth_row, deformed_row, contact_row;
    int rows, columns, cell, reach, parts;
    Edge edge;
    uint8_t *contact;
    PartOfWork beside;
    void *with;
} Touching;

int find_contact(const Touching *of);
int above_tail(const float *depth, const uint8_t *deformed, uint8_t *tail, int64_t width, int rows, int columns, float most_of_tail, uint8_t *core,
               uint8_t *line, Edge *edge);
EXPORT int contact_from_depth(const float *depth, int64_t depth_frame, int64_t depth_row, const float *gradient, const uint8_t *deformed,
                              int64_t deformed_frame, int64_t deformed_row, int frames, int rows, int columns, int cell, int reach,
                              const float *numbers, uint8_t *contact);
EXPORT void uncrop(const float *gradient, const uint8_t *contact, int frames, int rows, int columns, int top, int left, int height, int width,
                   float *whole, float *normal, uint8_t *touching);

/* What depth_slopes() and uncrop() are given, of one frame: slopes of a window whose rows of depth and mask lie at these distances; a window's gradient, and
   contact or null, and where they go in the whole image. */
typedef struct {
    const float *depth;
    int64_t depth_row;
    const uint8_t *mask;
    int64_t mask_row;
    float half_per_mm;
    int rows, columns;
    float *gradient;
} Slopes;

typedef struct {
    const float *gradient;
    const uint8_t *contact;
    int rows, columns, top, left, height, width;
    float *whole, *normal;
    uint8_t *touching;
} Uncropping;

void rows_of_slopes(const Slopes *of, int first, int last);
void rows_uncropped(const Uncropping *of, int first, int last);

static inline int least(int a, int b) { return a < b ? a : b; }

/* to[j][i] = from[i][j] of 4 x 4 values. */
static inline void transpose(const float *from, size_t from_step, float *to, size_t to_step) {
#if defined(__SSE__)
    __m128 a = _mm_loadu_ps(from), b = _mm_loadu_ps(from + from_step), c = _mm_loadu_ps(from + 2 * from_step), d = _mm_loadu_ps(from + 3 * from_step);
    _MM_TRANSPOSE4_PS(a, b, c, d);
    _mm_storeu_ps(to, a), _mm_storeu_ps(to + to_step, b), _mm_storeu_ps(to + 2 * to_step, c), _mm_storeu_ps(to + 3 * to_step, d);
#else
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) to[j * to_step + i] = from[i * from_step + j];
#endif
}

/* dark_below() of torchvts/core/noise.py: whether a channel of such intensity is dark, where the flat skin has `flat`. */
static inline int is_dark(float intensity, float flat, float three_noises) {
    return (intensity < three_noises) & (intensity < 0.5f * flat) & (flat > three_noises);
}

/* How many of the first n bytes are `value`; 64 at a time, then eight. */
static inline int bytes_alike(const uint8_t *bytes, int n, uint8_t value) {
    const uint64_t all = value * UINT64_C(0x0101010101010101);
    int k = 0;
    for (uint64_t some[8], differ; k + 64 <= n; k += 64) {
        memcpy(some, bytes + k, sizeof some);
        differ = 0;
        for (int j = 0; j < 8; j++) differ |= some[j] ^ all;
        if (differ) break;
    }
    for (uint64_t eight; k + 8 <= n; k += 8) {
        memcpy(&eight, bytes + k, sizeof eight);
        if (eight != all) break;
    }
    while (k < n && bytes[k] == value) k++;
    return k;
}

/* Parts of at most 64 rows, an even number of them, in which threads work on a frame. */
static inline int bands_of(int rows) { return rows < 2 ? 1 : (rows + 127) / 128 * 2; }

#endif

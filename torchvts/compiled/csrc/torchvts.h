/* Depth from images of a visual-tactile sensor, in plain C without dependencies: a plan file (docs/plan.md), and a call for each image.
   Nothing is global: any number of threads may call for one plan at once. After the first frames nothing is allocated. */
#ifndef TORCHVTS_H
#define TORCHVTS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
#ifndef VTS_API
#define VTS_API
#endif

typedef struct vts_plan vts_plan;

enum { VTS_REASON = 256 }; /* bytes of a reason */

/* Reads the bytes of a plan file, which are copied. Null if they are no good plan; `reason` then says why and what to do, in a sentence. */
VTS_API vts_plan *vts_load(const void *bytes, size_t size, char reason[VTS_REASON]);
VTS_API void vts_free(vts_plan *plan);

typedef struct {
    double mm_per_pixel;
    int32_t height, width; /* of the images that it takes, pixels */
    int32_t metric;        /* 0: the scale of depth is not known, so that it is NOT in mm */
    int32_t about_size;
    const char *about; /* JSON: the unit, its mode, and who made it; ends with a zero */
    const void *bytes; /* of the file, to write it again */
    size_t size;
} vts_facts;

/* What a plan says of itself; both pointers live as long as the plan. */
VTS_API void vts_info(const vts_plan *plan, vts_facts *facts);

/* Of the pixels of an image: bytes R, G, B or B, G, R after one another, row by row; or float planes R, G, B (3, height, width) in [0, 1]. */
enum { VTS_RGB8, VTS_BGR8, VTS_FLOAT };

/* Memory of the caller for what an image gives; null for what is not wanted. */
typedef struct {
    float *depth_mm;   /* (height, width), mm; positive where the skin is pressed in */
    float *normal;     /* (3, height, width), unit vectors; x right, y down, z to the camera */
    uint8_t *contact;  /* (height, width), 1 where an object touches the skin */
    uint8_t *deformed; /* (height, width), 1 where the skin has moved */
    float *gradient;   /* (2, height, width), slopes of depth along x and y */
    float *conditions; /* (22), the light of the frame and what it hides: see docs/plan.md */
} vts_output;

enum { VTS_DONE, VTS_NO_MEMORY, VTS_BAD_ARGUMENT, VTS_BAD_VALUES };
/* Depth of an image of the size that vts_info() says; VTS_DONE, or a code that vts_error() puts into a sentence. */
VTS_API int vts_depth(vts_plan *plan, const void *image, int format, const vts_output *output);
VTS_API const char *vts_error(int code);
/* A plan of the same unit with another image without contact; the old one stays, and both are freed. Null, and a reason, where there can be none. */
VTS_API vts_plan *vts_background(const vts_plan *plan, const void *image, int format, char reason[VTS_REASON]);

#ifdef __cplusplus
}
#endif
#endif

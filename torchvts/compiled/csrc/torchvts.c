/* The interface for others: torchvts.h, which explains it. */
#include "kernels.h"
#define VTS_API EXPORT
#include "load.h"

#include <stdatomic.h>
#include <stdio.h>

enum { MOST_IDLE = 64 };

/* A plan, its file, and memory of frames that nobody works in now: a thread takes one, or makes one where there is none. */
struct vts_plan {
    Plan plan;
    char *block;          /* all of the memory below */
    const uint8_t *bytes; /* of the file */
    size_t size, about_size;
    _Atomic(Scratch *) idle[MOST_IDLE];
};

static vts_plan *short_of_memory(char *reason) {
    snprintf(reason, VTS_REASON, "no memory is left for the plan");
    return NULL;
}

vts_plan *vts_load(const void *bytes, size_t size, char reason[VTS_REASON]) {
    vts_plan *made = calloc(1, sizeof *made);
    if (!made || size > SIZE_MAX - LINE || !(made->block = malloc(size + LINE))) return free(made), short_of_memory(reason);
    uint8_t *copy = (uint8_t *)made->block + (LINE - (size_t)made->block % LINE);
    memcpy(copy, bytes, size);
    made->bytes = copy, made->size = size;
    reason[0] = 0;
    if (!read_plan(copy, size, &made->plan, &made->about_size, reason)) return vts_free(made), NULL;
    double *poisson = malloc(poisson_size((int)made->plan.height));
    if (!poisson) return vts_free(made), short_of_memory(reason);
    make_poisson((int)made->plan.height, (int)made->plan.width, poisson);
    made->plan.poisson = poisson;
    return made;
}

void vts_free(vts_plan *plan) {
    if (!plan) return;
    for (int k = 0; k < MOST_IDLE; k++) {
        Scratch *scratch = atomic_load(&plan->idle[k]);
        if (scratch) free_scratch(scratch), free(scratch);
    }
    free((void *)plan->plan.poisson), free(plan->block), free(plan);
}

void vts_info(const vts_plan *plan, vts_facts *facts) {
    const Plan *p = &plan->plan;
    *facts = (vts_facts){p->mm_per_pixel, (int32_t)p->height, (int32_t)p->width, (int32_t)p->metric, (int32_t)plan->about_size,
                         (const char *)plan->bytes + LINE, plan->bytes, plan->size};
}

static Scratch *take_scratch(vts_plan *plan) {
    for (int k = 0; k < MOST_IDLE; k++) {
        Scratch *found = atomic_exchange(&plan->idle[k], NULL);
        if (found) return found;
    }
    return calloc(1, sizeof(Scratch));
}

static void put_scratch(vts_plan *plan, Scratch *scratch) {
    end_of_frame(scratch);
    for (int k = 0; k < MOST_IDLE; k++) {
        Scratch *none = NULL;
        if (atomic_compare_exchange_strong(&plan->idle[k], &none, scratch)) return;
    }
    free_scratch(scratch), free(scratch);
}

/* Bytes of pixels to float planes in [0, 1]; first: where red stands. */
static WIDE void planes_of(const uint8_t *restrict image, size_t pixels, int first, float *restrict planes) {
    for (int c = 0; c < 3; c++)
        for (size_t k = 0; k < pixels; k++) planes[c * pixels + k] = (float)image[3 * k + (size_t)(first ? first - c : c)] / 255.0f;
}

static int in_range(const float *planes, size_t pixels) {
    float ends[2];
    range(planes, 3 * pixels, ends);
    return ends[0] >= 0.0f && ends[1] <= 1.0f;
}

static int frame(const Plan *plan, Scratch *scratch, const void *image, int format, const vts_output *to) {
    const size_t pixels = (size_t)plan->height * plan->width;
    float *own = lend(scratch, 6 * sizeof(float) * pixels), *planes = format == VTS_FLOAT ? NULL : lend(scratch, 3 * sizeof(float) * pixels);
    uint8_t *masks = lend(scratch, 2 * pixels);
    float conditions[22];
    if (!own || !masks || (format != VTS_FLOAT && !planes)) return VTS_NO_MEMORY;
    if (planes) planes_of(image, pixels, format == VTS_BGR8 ? 2 : 0, planes), image = planes;
    else if (!in_range(image, pixels)) return VTS_BAD_VALUES;
    const int code = reconstruct(plan, scratch, image, to->conditions ? to->conditions : conditions, to->depth_mm ? to->depth_mm : own,
                                 to->gradient ? to->gradient : own + pixels, to->normal ? to->normal : own + 3 * pixels,
                                 to->contact ? to->contact : masks, to->deformed ? to->deformed : masks + pixels);
    return code == DONE ? VTS_DONE : VTS_NO_MEMORY;
}

int vts_depth(vts_plan *plan, const void *image, int format, const vts_output *output) {
    if (!plan || !image || !output || format < VTS_RGB8 || format > VTS_FLOAT) return VTS_BAD_ARGUMENT;
    Scratch *scratch = take_scratch(plan);
    if (!scratch) return VTS_NO_MEMORY;
    const int code = frame(&plan->plan, scratch, image, format, output);
    put_scratch(plan, scratch);
    return code;
}

vts_plan *vts_background(const vts_plan *plan, const void *image, int format, char reason[VTS_REASON]) {
    if (!plan || !image || format < VTS_RGB8 || format > VTS_FLOAT) return refuse(reason, "%s", vts_error(VTS_BAD_ARGUMENT)), NULL;
    const size_t pixels = (size_t)plan->plan.height * plan->plan.width;
    if (format == VTS_FLOAT && !in_range(image, pixels)) return refuse(reason, "%s", vts_error(VTS_BAD_VALUES)), NULL;
    float *planes = malloc(3 * sizeof(float) * pixels);
    if (!planes) return short_of_memory(reason);
    if (format != VTS_FLOAT) planes_of(image, pixels, format == VTS_BGR8 ? 2 : 0, planes), image = planes;
    size_t size;
    uint8_t *bytes = with_background(&plan->plan, image, (const char *)plan->bytes + LINE, plan->about_size, &size, reason);
    vts_plan *made = bytes ? vts_load(bytes, size, reason) : NULL;
    free(bytes), free(planes);
    return made;
}

const char *vts_error(int code) {
    static const char *const WORDS[] = {"done", "no memory is left for the tables of a frame", "expected a plan, an image, a format and an output, got none, or another format",
                                        "image: expected finite values in [0, 1]: divide by 255?"};
    return code >= 0 && code < (int)(sizeof WORDS / sizeof *WORDS) ? WORDS[code] : "no code of vts_depth()";
}

/* A plan of the bytes of a file: see load.c. */
#ifndef TORCHVTS_LOAD_H
#define TORCHVTS_LOAD_H

#include "plan.h"
#include "torchvts.h"

enum { PLAN_VERSION = 3 };

/* Reads and checks a file that lies at a multiple of LINE; its tables stay where they are. 0 if it is refused, with a reason. The text about it follows
   the first LINE bytes. */
int read_plan(const uint8_t *bytes, size_t size, Plan *plan, size_t *about_size, char *reason);

/* The bytes of a file of a plan and the text about it, which are the caller's to free; null where memory is short. */
uint8_t *write_plan(const Plan *plan, const char *about, size_t about_size, size_t *size);

/* background.c: those of a plan with another image without contact (3, height, width), or null, with a reason. */
uint8_t *with_background(const Plan *plan, const float *image, const char *about, size_t about_size, size_t *size, char *reason);

/* Writes a reason, as printf does; returns 0. */
int refuse(char *reason, const char *format, ...);

#endif

/* A plan of the bytes of a file: see load.c. */
#ifndef TORCHVTS_LOAD_H
#define TORCHVTS_LOAD_H

#include "plan.h"
#include "torchvts.h"

enum { PLAN_VERSION = 1 };

/* Reads and checks a file that lies at a multiple of LINE; its tables stay where they are. 0 if it is refused, with a reason. The text about it follows
   the first LINE bytes. */
int read_plan(const uint8_t *bytes, size_t size, Plan *plan, size_t *about_size, char *reason);

#endif

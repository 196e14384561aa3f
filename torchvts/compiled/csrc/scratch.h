/* Memory that the stages of a frame work in, last in, first out: what the first frame needed is there for all that follow. */
#ifndef TORCHVTS_SCRATCH_H
#define TORCHVTS_SCRATCH_H

#include <stddef.h>

/* Zeros to begin with. A block, of which `used` bytes are in use; what did not fit into it is in blocks of its own until the frame ends. */
typedef struct {
    char *memory;
    size_t size, used, most;
    struct Block *more;
} Scratch;

enum { LINE = 64 }; /* bytes of a line of the processor's cache: all begins at one, in files too */

void *lend(Scratch *scratch, size_t bytes);         /* null where memory is short; for any type, and not cleared */
void give_back(Scratch *scratch, size_t used);      /* all that was lent since `used` was scratch->used */
void end_of_frame(Scratch *scratch);                /* all of it, and makes the block as large as was needed */
void free_scratch(Scratch *scratch);

#endif

/* Memory of a frame: see scratch.h. */
#include "scratch.h"

#include <stdlib.h>

typedef struct Block {
    struct Block *next;
    double first[]; /* what was lent */
} Block;


static void free_more(Scratch *scratch) {
    while (scratch->more) {
        struct Block *next = scratch->more->next;
        free(scratch->more);
        scratch->more = next;
    }
}

void *lend(Scratch *scratch, size_t bytes) {
    const size_t from = scratch->used, to = from + (bytes + LINE - 1) / LINE * LINE;
    scratch->used = to;
    if (to > scratch->most) scratch->most = to;
    if (to <= scratch->size) return scratch->memory + (LINE - (size_t)scratch->memory % LINE) % LINE + from;
    Block *block = malloc(sizeof(Block) + bytes);
    if (!block) return NULL;
    block->next = scratch->more, scratch->more = block;
    return block->first;
}

void give_back(Scratch *scratch, size_t used) { scratch->used = used; }

void end_of_frame(Scratch *scratch) {
    free_more(scratch);
    scratch->used = 0;
    if (scratch->most <= scratch->size) return;
    free(scratch->memory);
    scratch->memory = malloc(scratch->most + LINE);
    scratch->size = scratch->memory ? scratch->most : 0;
}

void free_scratch(Scratch *scratch) {
    free_more(scratch);
    free(scratch->memory);
}

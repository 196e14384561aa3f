/* Memory of the kernels, kept from call to call. What a program gives back, its allocator may give back to the system, and pages that the
   system hands out anew cost more than most kernels: 0.2 to 1 us each, and a frame of 320 x 240 needs a thousand. */
#define TORCHVTS_MEMORY
#include "kernels.h"

#include <stdatomic.h>

enum { PLACES = 64, HEAD = 64 };

/* Most bytes that are kept. */
static const size_t MOST = (size_t)64 << 20;

/* What lies before each piece of memory, HEAD bytes. */
typedef struct {
    size_t size;
} Head;

static Head *kept[PLACES];
static size_t kept_bytes;
static atomic_flag busy = ATOMIC_FLAG_INIT;

/* The smallest kept piece that holds `size` bytes and is not twice as large, or a new one. Another thread may be at the table, and after a fork
   for ever; then nobody waits. */
void *kept_memory(size_t size) {
    Head *found = NULL;
    if (!atomic_flag_test_and_set_explicit(&busy, memory_order_acquire)) {
        int best = -1;
        for (int k = 0; k < PLACES; k++)
            if (kept[k] && kept[k]->size >= size && kept[k]->size / 2 <= size && (best < 0 || kept[k]->size < kept[best]->size)) best = k;
        if (best >= 0) {
            found = kept[best];
            kept[best] = NULL;
            kept_bytes -= found->size;
        }
        atomic_flag_clear_explicit(&busy, memory_order_release);
    }
    if (!found) {
        found = malloc(HEAD + size);
        if (!found) return NULL;
        found->size = size;
    }
    return (char *)found + HEAD;
}

void *kept_zeros(size_t count, size_t size) {
    void *memory = kept_memory(count * size);
    return memory ? memset(memory, 0, count * size) : NULL;
}

/* Takes the next place of the table in turn, and frees what is there. */
static int clear_place(void) {
    static unsigned int turn;
    const int place = (int)(turn++ % PLACES);
    if (kept[place]) kept_bytes -= kept[place]->size;
    free(kept[place]);
    kept[place] = NULL;
    return place;
}

/* Keeps a piece of memory for the next call, if need be in place of others. */
void give_back(void *memory) {
    if (!memory) return;
    Head *given = (Head *)((char *)memory - HEAD);
    if (given->size <= MOST && !atomic_flag_test_and_set_explicit(&busy, memory_order_acquire)) {
        int place = -1;
        for (int k = 0; k < PLACES && place < 0; k++)
            if (!kept[k]) place = k;
        while (place < 0 || kept_bytes + given->size > MOST) place = clear_place();
        kept_bytes += given->size;
        kept[place] = given;
        given = NULL;
        atomic_flag_clear_explicit(&busy, memory_order_release);
    }
    free(given);
}

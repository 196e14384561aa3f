/* Damages a plan file many times and reads it: fuzz_plan FILE COUNT SEED. Half of the damaged files get a checksum that fits, so that the checks behind
   it are reached; a frame is then reconstructed, and is a new background. Built with sanitizers, which end the program at the first report. A damaged file without a new checksum
   must be refused. Prints how many were read, refused, and accepted as they were not written. */
#include "torchvts.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t state;

static uint64_t next(void) { /* xorshift64* of Vigna */
    state ^= state >> 12, state ^= state << 25, state ^= state >> 27;
    return state * 2685821657736338717u;
}

static size_t below(size_t n) { return n ? (size_t)(next() % n) : 0; }

static uint32_t checksum(const unsigned char *bytes, size_t size) {
    uint32_t sum = 0xffffffffu;
    for (size_t k = 0; k < size; k++) {
        sum ^= bytes[k];
        for (int bit = 0; bit < 8; bit++) sum = sum >> 1 ^ (sum & 1 ? 0xedb88320u : 0);
    }
    return ~sum;
}

/* A place: anywhere, or, as records are few among the bytes, in the head or a record or the number behind it. */
static size_t place(const unsigned char *bytes, size_t size) {
    if (size <= 64 || below(4) == 0) return below(size);
    for (int tries = 0; tries < 400; tries++) {
        const size_t line = below(size / 64);
        const unsigned char *at = bytes + 64 * line;
        const int named = at[0] >= 'a' && at[0] <= 'z' && at[31] == 0 && at[33] == 0 && at[63] == 0;
        if (line == 0 || named) return 64 * line + (below(2) && 64 * line + 72 < size ? 64 : 32 * below(2)) + below(16);
    }
    return below(size);
}

static void damage(unsigned char *bytes, size_t *size) {
    static const int64_t WORDS[] = {0, 1, -1, 2, 3, 8, 255, 65536, INT32_MAX, INT64_MAX, INT64_MIN, 0x7ff0000000000000, 0x7ff8000000000000};
    static const double REALS[] = {0.0, -1.0, 1e-300, 1e11, 0.5, 7.0};
    for (size_t times = 1 + below(3); times; times--) {
        const size_t at = place(bytes, *size), aligned = at / 8 * 8;
        if (!*size) return;
        switch (below(6)) {
            case 0: bytes[at % *size] ^= (unsigned char)(1u << below(8)); break;
            case 1: bytes[at % *size] = (unsigned char)below(256); break;
            case 2: if (aligned + 8 <= *size) memcpy(bytes + aligned, WORDS + below(sizeof WORDS / 8), 8); break;
            case 3: if (aligned + 8 <= *size) memcpy(bytes + aligned, REALS + below(sizeof REALS / 8), 8); break;
            case 4: if (aligned + 8 <= *size) bytes[aligned] = (unsigned char)(bytes[aligned] + (below(2) ? 1 : -1)); break;
            default: if (below(4) == 0) *size = below(*size); else memmove(bytes + at % *size, bytes + below(*size), 1); break;
        }
    }
}

int main(int count, char **words) {
    FILE *file = count == 4 ? fopen(words[1], "rb") : NULL;
    if (!file) return 2;
    fseek(file, 0, SEEK_END);
    const size_t size = (size_t)ftell(file);
    unsigned char *good = malloc(size), *bad = malloc(size);
    rewind(file);
    if (fread(good, 1, size, file) != size) return 2;
    fclose(file);
    state = 88172645463325252u + strtoull(words[3], NULL, 10);
    long refused = 0, read = 0, wrong = 0;
    char reason[VTS_REASON];
    for (long left = atol(words[2]); left; left--) {
        size_t length = size;
        memcpy(bad, good, size);
        damage(bad, &length);
        const int same = length == size && !memcmp(bad, good, size), fits = (int)below(2);
        if (fits && length >= 64) {
            const uint64_t whole = length;
            memcpy(bad + 16, &whole, 8);
            const uint32_t sum = checksum(bad + 16, length - 16);
            memcpy(bad + 12, &sum, 4);
        }
        unsigned char *exact = malloc(length + !length); /* so that a byte behind it is seen */
        memcpy(exact, bad, length);
        vts_plan *plan = vts_load(exact, length, reason);
        free(exact);
        if (!plan) {
            refused++;
            if (!strlen(reason) || same) wrong++, printf("refused without a reason, or undamaged: '%s'\n", reason);
            continue;
        }
        read++;
        if (!fits && !same) wrong++, printf("accepted with other bytes\n");
        vts_facts facts;
        vts_info(plan, &facts);
        const size_t pixels = (size_t)facts.height * (size_t)facts.width;
        unsigned char *image = malloc(3 * pixels);
        float *depth = malloc(sizeof(float) * pixels);
        for (size_t k = 0; k < 3 * pixels; k++) image[k] = (unsigned char)(below(16) ? 60 + k % 90 : below(256));
        const vts_output output = {.depth_mm = depth};
        if (vts_depth(plan, image, VTS_RGB8, &output) > VTS_NO_MEMORY) wrong++;
        vts_plan *other = vts_background(plan, image, VTS_BGR8, reason); /* of point lights there is none */
        if (!other && !strlen(reason)) wrong++, printf("no background, without a reason\n");
        vts_free(other), free(image), free(depth), vts_free(plan);
    }
    free(good), free(bad);
    printf("read %ld, refused %ld, wrong %ld\n", read, refused, wrong);
    return wrong != 0;
}

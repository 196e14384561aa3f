/* Which sources the library was built from, so that one left over from others is not called. */
#include "kernels.h"

EXPORT uint32_t sources(void) { return SOURCES; }

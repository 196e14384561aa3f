/* A few threads that share the work of a frame. A thread that sleeps takes 0.05 ms to wake up, and where the machine is busy far longer, so
   nobody waits for one to come: work lies ready in parts, whoever is awake takes the next one, and the thread that asked takes whatever is left.
   It waits only for parts that others have begun. The parts of a piece of work, and hence its result, do not depend on the number of threads.
   Who asked takes parts from the first on, and helpers from the last on, so that each finds most of what it needs in its own cache. */
#define _GNU_SOURCE
#include "kernels.h"

#if defined(__unix__) || defined(__APPLE__)

#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <time.h>
#include <unistd.h>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

enum { MOST_HELPERS = 3, ROUNDS = 64 };

/* For so long a helper looks for more work before it sleeps, ns. */
static const int64_t PATIENCE = 200000;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t begun = PTHREAD_COND_INITIALIZER;
static int helpers, wanted, asleep; /* under the lock, as `frame` is */
static unsigned int frame;
static pthread_t threads_of[MOST_HELPERS];
static pid_t process;

static atomic_flag taken = ATOMIC_FLAG_INIT; /* one thread at a time has the helpers */
static _Thread_local int sharing;            /* whether this one has */
static _Thread_local int offered;            /* parts of the work that it has offered and not come back to */

/* The work at hand: which one, 32 bits, behind the last part that is left, 16, and the first, 16. What `work_of` and `work_with` are, those know who
   have taken a part, since they do not change before all parts are done. */
static _Atomic uint64_t ticket;
static atomic_int done;
static PartOfWork work_of;
static void *work_with;

static inline void rest_a_little(void) {
#if defined(__SSE2__)
    _mm_pause();
#endif
}

/* Takes the first part that is left, or the last one, and does it. Returns whether there was one. */
static int take_part(int last) {
    uint64_t at = atomic_load_explicit(&ticket, memory_order_acquire);
    for (;;) {
        const uint64_t from = at & 0xffff, to = at >> 16 & 0xffff;
        if (from >= to) return 0;
        const uint64_t rest = last ? at - (UINT64_C(1) << 16) : at + 1;
        if (!atomic_compare_exchange_weak_explicit(&ticket, &at, rest, memory_order_acq_rel, memory_order_acquire)) continue;
        work_of(work_with, (int)(last ? to - 1 : from));
        atomic_fetch_add_explicit(&done, 1, memory_order_release);
        return 1;
    }
}

static int64_t nanoseconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * (int64_t)1000000000 + now.tv_nsec;
}

static void *help(void *argument) {
    const int index = (int)(intptr_t)argument;
    unsigned int seen = 0;
    for (;;) {
        pthread_mutex_lock(&lock);
        asleep++;
        while (frame == seen || index >= wanted) pthread_cond_wait(&begun, &lock);
        asleep--;
        seen = frame;
        pthread_mutex_unlock(&lock);
        for (int64_t last = nanoseconds(); nanoseconds() - last < PATIENCE;)
            for (int k = 0; k < ROUNDS; k++) {
                if (take_part(1))
                    last = nanoseconds();
                else
                    rest_a_little();
            }
    }
    return NULL;
}

/* Starts helpers up to `count`, under the lock. Signals are for the threads of the program. */
static void start(int count) {
    sigset_t all, before;
    pthread_attr_t attributes;
    if (helpers >= count || pthread_attr_init(&attributes)) return;
    pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    while (helpers < count && !pthread_create(&threads_of[helpers], &attributes, help, (void *)(intptr_t)helpers)) helpers++;
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
}

/* Has up to `count` helpers ready, under the lock, on other processors than the caller's: a virtual machine's scheduler may take one that sleeps for a
   busy one and wake a helper where its caller runs, which then waits until that is done. Returns how many may work. */
#if defined(__linux__)
static int make_ready(int count) {
    static int before = -1;
    static int others = MOST_HELPERS;
    const int here = sched_getcpu();
    cpu_set_t allowed;
    if (here == before && helpers >= least(count, others)) return least(count, others);
    if (sched_getaffinity(0, sizeof allowed, &allowed)) CPU_ZERO(&allowed); /* more processors than the set holds: they are chosen by the system */
    others = CPU_COUNT(&allowed) ? CPU_COUNT(&allowed) - 1 : MOST_HELPERS;
    if (here >= 0) CPU_CLR((size_t)here, &allowed);
    start(least(count, others));
    for (int k = 0; k < helpers && CPU_COUNT(&allowed) > 0; k++) pthread_setaffinity_np(threads_of[k], sizeof allowed, &allowed);
    before = here;
    return least(count, least(others, helpers));
}
#else
static int make_ready(int count) {
    start(count);
    return least(count, helpers);
}
#endif

/* Has helpers look for work, for the thread that has `taken`. Returns how many. */
static int call_helpers(int threads) {
    const pid_t here = getpid();
    if (process != here) { /* a fork has the memory of its parent, but none of its helpers */
        static const pthread_mutex_t free_lock = PTHREAD_MUTEX_INITIALIZER;
        static const pthread_cond_t no_waiters = PTHREAD_COND_INITIALIZER;
        lock = free_lock, begun = no_waiters;
        helpers = asleep = 0, process = here;
    }
    pthread_mutex_lock(&lock);
    const int any = wanted = make_ready(least(threads - 1, MOST_HELPERS));
    frame++;
    const int wake = asleep > 0;
    pthread_mutex_unlock(&lock);
    if (wake) pthread_cond_broadcast(&begun);
    return any;
}

/* Until end_sharing(), share() lets up to `threads` threads work. Returns whether it does: not while another thread has the helpers. */
int begin_sharing(int threads) {
    if (threads < 2 || sharing || atomic_flag_test_and_set_explicit(&taken, memory_order_acquire)) return 0;
    sharing = call_helpers(threads) > 0;
    if (!sharing) atomic_flag_clear_explicit(&taken, memory_order_release);
    return sharing;
}

void end_sharing(int began) {
    if (!began) return;
    sharing = 0;
    atomic_flag_clear_explicit(&taken, memory_order_release);
}

static void lay_out(PartOfWork work, void *with, int parts) {
    work_of = work, work_with = with;
    atomic_store_explicit(&done, 0, memory_order_relaxed);
    const uint64_t turn = (atomic_load_explicit(&ticket, memory_order_relaxed) >> 32) + 1;
    atomic_store_explicit(&ticket, turn << 32 | (uint64_t)parts << 16, memory_order_release);
}

static void wait_for(int parts) {
    for (int k = 0; atomic_load_explicit(&done, memory_order_acquire) < parts; k++) {
        if (k < 1000)
            rest_a_little();
        else
            sched_yield();
    }
}

/* Calls work(with, part) for each of so many parts, at most 65,535, in any order and several at once; back when all are done. */
void share(PartOfWork work, void *with, int parts) {
    if (!sharing || offered || parts < 2) {
        for (int part = 0; part < parts; part++) work(with, part);
        return;
    }
    lay_out(work, with, parts);
    while (take_part(0)) continue;
    wait_for(parts);
}

/* Between begin_sharing() and join_in() or withdraw(): helpers begin such work while its thread does something else. */
void offer(PartOfWork work, void *with, int parts) {
    lay_out(work, with, parts);
    offered = parts;
}

/* Takes whatever is left of the work that was offered, and wakes helpers for what comes then; back when all is done. */
void join_in(int threads) {
    call_helpers(threads);
    while (take_part(0)) continue;
    wait_for(offered);
    offered = 0;
}

/* Leaves the rest of the work that was offered undone; back when nobody is at it any more. */
void withdraw(void) {
    uint64_t at = atomic_load_explicit(&ticket, memory_order_acquire);
    while (!atomic_compare_exchange_weak_explicit(&ticket, &at, at >> 32 << 32, memory_order_acq_rel, memory_order_acquire)) continue;
    wait_for(offered - (int)((at >> 16 & 0xffff) - (at & 0xffff)));
    offered = 0;
}

/* Two threads write the same number in turn, which takes a line of memory from cache to cache each time. */
typedef struct {
    atomic_int turn, over;
    int64_t began, ended;
} Exchange;

enum { EXCHANGES = 2000, WARM_UP = 200, SPINS = 4096 };

/* For so long the first waits for the second, which may sleep, ns. */
static const int64_t MOST_WAIT = 20000000;

static void exchange(void *with, int side) {
    Exchange *of = with;
    const int64_t latest = nanoseconds() + MOST_WAIT;
    for (int k = 0; k < EXCHANGES && !of->over; k++) {
        for (int spins = 1; of->turn != 2 * k + side && !of->over; spins++)
            if (spins % SPINS == 0 && side == 0 && nanoseconds() > latest) of->over = 1;
        if (side == 0 && k == WARM_UP) of->began = nanoseconds();
        of->turn = 2 * k + side + 1;
    }
    if (side == 0) of->ended = nanoseconds();
}

/* Time that a line of memory takes from one processor's cache to another's and back, ns: some 50 where they share a part of it, some 300 where they
   do not. 0 where no second thread comes. */
EXPORT double exchange_ns(void) {
    Exchange of = {0};
    const int shared = begin_sharing(2);
    if (!shared) return 0.0;
    share(exchange, &of, 2);
    end_sharing(shared);
    return of.over ? 0.0 : (double)(of.ended - of.began) / (EXCHANGES - WARM_UP);
}

#else

EXPORT double exchange_ns(void) { return 0.0; }

int begin_sharing(int threads) {
    (void)threads;
    return 0;
}

void end_sharing(int began) { (void)began; }

void share(PartOfWork work, void *with, int parts) {
    for (int part = 0; part < parts; part++) work(with, part);
}

/* Without helpers nobody begins to share. */
void offer(PartOfWork work, void *with, int parts) { share(work, with, parts); }

void join_in(int threads) { (void)threads; }

void withdraw(void) {}

#endif

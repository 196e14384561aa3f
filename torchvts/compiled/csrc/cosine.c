/* Cosine transforms of LINES real lines side by side, value after value: element y of all of them lies together, so that one instruction
   works on many lines. Two lines make one complex line (Makhoul, A fast cosine transform in one and two dimensions, IEEE Trans. ASSP 28(1),
   1980); the Fourier transform is Stockham's, in factors of 4, 2, 3, 5 and any other prime up to MOST_RADIX. */
#include "cosine.h"

#include <math.h>

static const double TURN = 6.283185307179586476925286766559;

/* The factors of n, their number returned; 0 where one is too large. */
int cosine_radices(int n, int *radix) {
    int count = 0;
    while (n % 4 == 0) radix[count++] = 4, n /= 4;
    for (int p = 2; n > 1; p++)
        for (; n % p == 0; n /= p) {
            if (p > MOST_RADIX) return 0;
            radix[count++] = p;
        }
    return count;
}

/* Floats of the tables for lines of n values: turns, then for each pass its roots of one and its twiddles. */
size_t cosine_table_size(int n) {
    int radix[MOST_PASSES], count = cosine_radices(n, radix);
    size_t size = 2 * (size_t)(n / 2 + 1);
    for (int k = 0, rest = n; k < count; k++) {
        rest /= radix[k];
        size += 2 * (size_t)radix[k] + 2 * (size_t)(radix[k] - 1) * rest;
    }
    return size;
}

static float *put_turn(float *to, double angle) {
    to[0] = (float)cos(angle), to[1] = (float)sin(angle);
    return to + 2;
}

void make_cosine_tables(int n, float *tables) {
    int radix[MOST_PASSES], count = cosine_radices(n, radix);
    for (int k = 0; k <= n / 2; k++) tables = put_turn(tables, TURN * k / (4.0 * n));
    for (int k = 0, rest = n; k < count; k++) {
        const int p = radix[k], whole = rest;
        rest /= p;
        for (int i = 0; i < p; i++) tables = put_turn(tables, TURN * i / p);
        for (int j = 0; j < rest; j++)
            for (int i = 1; i < p; i++) tables = put_turn(tables, TURN * (double)(i * j % whole) / whole);
    }
}

Cosine cosine_of(int n, const float *tables) {
    Cosine of = {.n = n, .turns = tables, .twiddles = tables + 2 * (n / 2 + 1)};
    of.passes = cosine_radices(n, of.radix);
    return of;
}

/* Floats of scratch: the lines, and the lines again. */
size_t cosine_scratch_size(int n) { return 2 * (size_t)n * LINES; }

/* One factor p of a transform: from x[q + s (j + m k)] to y[q + s (p j + i)], q below s and each of LANES values; two arrays each for real and
   imaginary parts. All lanes and q lie together: `run` of them. */
WIDE FUSED static void by_two(const float *restrict xr, const float *restrict xi, float *restrict yr, float *restrict yi, const float *restrict turn,
                              int m, int run) {
    const size_t step = (size_t)m * run;
    for (int j = 0; j < m; j++, turn += 2, xr += run, xi += run, yr += 2 * run, yi += 2 * run) {
        const float c = turn[0], s = turn[1];
        INDEPENDENT for (int t = 0; t < run; t++) {
            const float ar = xr[t], ai = xi[t], br = xr[step + t], bi = xi[step + t];
            const float dr = ar - br, di = ai - bi;
            yr[t] = ar + br, yi[t] = ai + bi;
            yr[run + t] = dr * c + di * s, yi[run + t] = di * c - dr * s;
        }
    }
}

WIDE FUSED static void by_four(const float *restrict xr, const float *restrict xi, float *restrict yr, float *restrict yi,
                               const float *restrict turn, int m, int run) {
    const size_t step = (size_t)m * run;
    for (int j = 0; j < m; j++, turn += 6, xr += run, xi += run, yr += 4 * run, yi += 4 * run) {
        const float c1 = turn[0], s1 = turn[1], c2 = turn[2], s2 = turn[3], c3 = turn[4], s3 = turn[5];
        INDEPENDENT for (int t = 0; t < run; t++) {
            const float ar = xr[t], ai = xi[t], br = xr[step + t], bi = xi[step + t];
            const float cr = xr[2 * step + t], ci = xi[2 * step + t], dr = xr[3 * step + t], di = xi[3 * step + t];
            const float er = ar + cr, ei = ai + ci, fr = ar - cr, fi = ai - ci, gr = br + dr, gi = bi + di, hr = br - dr, hi = bi - di;
            const float ur = fr + hi, ui = fi - hr, vr = er - gr, vi = ei - gi, wr = fr - hi, wi = fi + hr;
            yr[t] = er + gr, yi[t] = ei + gi;
            yr[run + t] = ur * c1 + ui * s1, yi[run + t] = ui * c1 - ur * s1;
            yr[2 * run + t] = vr * c2 + vi * s2, yi[2 * run + t] = vi * c2 - vr * s2;
            yr[3 * run + t] = wr * c3 + wi * s3, yi[3 * run + t] = wi * c3 - wr * s3;
        }
    }
}

/* An odd factor; inlined with p constant, its loops unroll. */
static inline __attribute__((always_inline)) void by_odd(const float *restrict xr, const float *restrict xi, float *restrict yr,
                                                         float *restrict yi, const float *restrict root, const float *restrict turn, int p, int m,
                                                         int run) {
    const size_t step = (size_t)m * run;
    for (int j = 0; j < m; j++, turn += 2 * (p - 1), xr += run, xi += run, yr += p * run, yi += p * run)
        INDEPENDENT for (int t = 0; t < run; t++) {
            float sum_r[MOST_RADIX / 2], sum_i[MOST_RADIX / 2], less_r[MOST_RADIX / 2], less_i[MOST_RADIX / 2];
            const float first_r = xr[t], first_i = xi[t];
            float all_r = first_r, all_i = first_i;
            for (int k = 1; k <= p / 2; k++) {
                const float ar = xr[k * step + t], ai = xi[k * step + t], br = xr[(p - k) * step + t], bi = xi[(p - k) * step + t];
                sum_r[k - 1] = ar + br, sum_i[k - 1] = ai + bi, less_r[k - 1] = ar - br, less_i[k - 1] = ai - bi;
                all_r += sum_r[k - 1], all_i += sum_i[k - 1];
            }
            yr[t] = all_r, yi[t] = all_i;
            for (int i = 1; i <= p / 2; i++) {
                float ar = first_r, ai = first_i, br = 0.0f, bi = 0.0f;
                for (int k = 1; k <= p / 2; k++) {
                    const float c = root[2 * (i * k % p)], s = root[2 * (i * k % p) + 1];
                    ar += c * sum_r[k - 1], ai += c * sum_i[k - 1], br += s * less_r[k - 1], bi += s * less_i[k - 1];
                }
                const float ur = ar + bi, ui = ai - br, vr = ar - bi, vi = ai + br;
                const float *one = turn + 2 * (i - 1), *other = turn + 2 * (p - i - 1);
                yr[i * run + t] = ur * one[0] + ui * one[1], yi[i * run + t] = ui * one[0] - ur * one[1];
                yr[(p - i) * run + t] = vr * other[0] + vi * other[1], yi[(p - i) * run + t] = vi * other[0] - vr * other[1];
            }
        }
}

WIDE FUSED static void by_three(const float *xr, const float *xi, float *yr, float *yi, const float *root, const float *turn, int m, int run) {
    by_odd(xr, xi, yr, yi, root, turn, 3, m, run);
}

WIDE FUSED static void by_five(const float *xr, const float *xi, float *yr, float *yi, const float *root, const float *turn, int m, int run) {
    by_odd(xr, xi, yr, yi, root, turn, 5, m, run);
}

/* The same for any odd factor, sum after sum. */
WIDE FUSED static void by_prime(const float *restrict xr, const float *restrict xi, float *restrict yr, float *restrict yi,
                                const float *restrict root, const float *restrict turn, int p, int m, int run) {
    const size_t step = (size_t)m * run;
    for (int j = 0; j < m; j++, turn += 2 * (p - 1), xr += run, xi += run, yr += p * run, yi += p * run) {
        INDEPENDENT for (int t = 0; t < run; t++) yr[t] = xr[t], yi[t] = xi[t];
        for (int k = 1; k < p; k++)
            INDEPENDENT for (int t = 0; t < run; t++) yr[t] += xr[k * step + t], yi[t] += xi[k * step + t];
        for (int i = 1; i <= p / 2; i++) {
            float *restrict or = yr + i * run, *restrict oi = yi + i * run, *restrict nr = yr + (p - i) * run, *restrict ni = yi + (p - i) * run;
            INDEPENDENT for (int t = 0; t < run; t++) or[t] = xr[t], oi[t] = xi[t], nr[t] = 0.0f, ni[t] = 0.0f;
            for (int k = 1; k <= p / 2; k++) {
                const float c = root[2 * (i * k % p)], s = root[2 * (i * k % p) + 1];
                const float *ar = xr + k * step, *ai = xi + k * step, *br = xr + (p - k) * step, *bi = xi + (p - k) * step;
                INDEPENDENT for (int t = 0; t < run; t++) {
                    or[t] += c * (ar[t] + br[t]), oi[t] += c * (ai[t] + bi[t]);
                    nr[t] += s * (ar[t] - br[t]), ni[t] += s * (ai[t] - bi[t]);
                }
            }
            const float *one = turn + 2 * (i - 1), *other = turn + 2 * (p - i - 1);
            INDEPENDENT for (int t = 0; t < run; t++) {
                const float ur = or[t] + ni[t], ui = oi[t] - nr[t], vr = or[t] - ni[t], vi = oi[t] + nr[t];
                or[t] = ur * one[0] + ui * one[1], oi[t] = ui * one[0] - ur * one[1];
                nr[t] = vr * other[0] + vi * other[1], ni[t] = vi * other[0] - vr * other[1];
            }
        }
    }
}

/* Fourier transforms of LANES lines of n pairs; the parts xr, xi, and as much memory yr, yi. Returns whether the result lies in the latter. */
static int fourier(const Cosine *of, float *xr, float *xi, float *yr, float *yi) {
    const float *table = of->twiddles;
    for (int pass = 0, rest = of->n, done = 1; pass < of->passes; pass++) {
        const int p = of->radix[pass], m = rest / p, run = done * LANES;
        const float *turn = table + 2 * p;
        if (p == 4)
            by_four(xr, xi, yr, yi, turn, m, run);
        else if (p == 2)
            by_two(xr, xi, yr, yi, turn, m, run);
        else if (p == 3)
            by_three(xr, xi, yr, yi, table, turn, m, run);
        else if (p == 5)
            by_five(xr, xi, yr, yi, table, turn, m, run);
        else
            by_prime(xr, xi, yr, yi, table, turn, p, m, run);
        table = turn + 2 * (size_t)(p - 1) * m;
        rest = m, done *= p;
        float *swapped = xr;
        xr = yr, yr = swapped, swapped = xi, xi = yi, yi = swapped;
    }
    return of->passes % 2;
}

/* Where row y of the lines lies in the scratch memory: the first LANES of them; the others lie n * LANES further. */
float *cosine_line(const Cosine *of, float *scratch, int y) {
    return scratch + (size_t)(y % 2 ? of->n - 1 - y / 2 : y / 2) * LANES;
}

/* Coefficients k and n - k of the two lines of each pair, from what the Fourier transform has there. */
WIDE FUSED static void split(const float *restrict zr, const float *restrict zi, const float *restrict turn, int n, int lanes, float *restrict found) {
    for (int t = 0; t < lanes; t++) found[t] = zr[t], found[lanes + t] = zi[t];
    for (int k = 1; k <= n / 2; k++) {
        const float c = 0.5f * turn[2 * k], s = 0.5f * turn[2 * k + 1];
        const size_t at = (size_t)k * lanes, back = (size_t)(n - k) * lanes;
        INDEPENDENT for (int t = 0; t < lanes; t++) {
            const float ar = zr[at + t], ai = zi[at + t], br = zr[back + t], bi = zi[back + t];
            const float pr = ar + br, pi = ai - bi, qr = ai + bi, qi = br - ar;
            found[2 * back + t] = s * pr - c * pi, found[2 * back + lanes + t] = s * qr - c * qi;
            found[2 * at + t] = c * pr + s * pi, found[2 * at + lanes + t] = c * qr + s * qi;
        }
    }
}

/* The inverse of split(). */
WIDE FUSED static void join(const float *restrict found, const float *restrict turn, int n, int lanes, float *restrict zr, float *restrict zi) {
    for (int t = 0; t < lanes; t++) zr[t] = found[t], zi[t] = found[lanes + t];
    for (int k = 1; k <= n / 2; k++) {
        const float c = turn[2 * k], s = turn[2 * k + 1];
        const size_t at = (size_t)k * lanes, back = (size_t)(n - k) * lanes;
        INDEPENDENT for (int t = 0; t < lanes; t++) {
            const float a = found[2 * at + t], b = found[2 * back + t], d = found[2 * at + lanes + t], e = found[2 * back + lanes + t];
            const float pr = c * a + s * b, pi = s * a - c * b, qr = c * d + s * e, qi = s * d - c * e;
            zr[back + t] = pr + qi, zi[back + t] = qr - pi;
            zr[at + t] = pr - qi, zi[at + t] = pi + qr;
        }
    }
}

/* Coefficients (n, LINES) of the lines that lie in `scratch` as cosine_line() says: sums of value y times cos(pi k (2 y + 1) / 2n). */
void cosine_forward(const Cosine *of, float *scratch, float *found) {
    const size_t part = (size_t)of->n * LANES;
    float *other = scratch + 2 * part;
    const float *z = fourier(of, scratch, scratch + part, other, other + part) ? other : scratch;
    split(z, z + part, of->turns, of->n, LANES, found);
}

/* The lines with such coefficients, times n, to `lines`, where they lie as cosine_line() says; scratch: as much memory. */
void cosine_inverse(const Cosine *of, const float *coefficients, float *scratch, float *lines) {
    const size_t part = (size_t)of->n * LANES;
    float *from = of->passes % 2 ? scratch : lines, *to = of->passes % 2 ? lines : scratch;
    join(coefficients, of->turns, of->n, LANES, from, from + part);
    fourier(of, from + part, from, to + part, to); /* with real and imaginary parts exchanged, the transform there is the one back */
}

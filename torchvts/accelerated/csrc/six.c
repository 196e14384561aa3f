/* Symmetric matrices of six scaled twists, or of three shifts, and directions among these. */
#include "track.h"

/* to = A * B * A^T */
void both_sides(double A[6][6], double B[6][6], double to[6][6]) {
    double half[6][6] = {{0.0}};
    for (int i = 0; i < 6; i++)
        for (int m = 0; m < 6; m++)
            for (int k = 0; k < 6; k++) half[i][k] += A[i][m] * B[m][k];
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) {
            to[i][k] = 0.0;
            for (int m = 0; m < 6; m++) to[i][k] += half[i][m] * A[k][m];
        }
}

double trace_of(double A[6][6], int n) {
    double trace = 0.0;
    for (int k = 0; k < n; k++) trace += A[k][k];
    return trace;
}

/* The inverse of a symmetric positive A. */
void invert_six(double A[6][6], double inverse[6][6]) {
    for (int k = 0; k < 6; k++) {
        double B[6][6], one[6] = {0.0};
        memcpy(B, A, sizeof B);
        one[k] = 1.0;
        solve_six(B, one, inverse[k]);
    }
}

/* Eigenvalues and, in columns, eigenvectors of n rows and columns, from the first on, of a symmetric matrix, by Jacobi's rotations. */
void eigen_six(double matrix[6][6], int first, int n, double values[6], double vectors[6][6]) {
    double A[6][6];
    for (int i = 0; i < n; i++)
        for (int k = 0; k < n; k++) A[i][k] = matrix[first + i][first + k], vectors[i][k] = i == k ? 1.0 : 0.0;
    for (int sweep = 0; sweep < 30; sweep++) {
        double on = 0.0, off = 0.0;
        for (int i = 0; i < n; i++) {
            on += A[i][i] * A[i][i];
            for (int k = i + 1; k < n; k++) off += A[i][k] * A[i][k];
        }
        if (off <= 1e-31 * on) break;
        for (int i = 0; i < n; i++)
            for (int k = i + 1; k < n; k++) {
                if (A[i][k] == 0.0) continue;
                const double ratio = (A[k][k] - A[i][i]) / (2.0 * A[i][k]);
                const double tangent = (ratio >= 0.0 ? 1.0 : -1.0) / (fabs(ratio) + sqrt(ratio * ratio + 1.0));
                const double c = 1.0 / sqrt(tangent * tangent + 1.0), s = tangent * c;
                for (int m = 0; m < n; m++) {
                    const double a = A[m][i], b = A[m][k], v = vectors[m][i], w = vectors[m][k];
                    A[m][i] = c * a - s * b, A[m][k] = s * a + c * b;
                    vectors[m][i] = c * v - s * w, vectors[m][k] = s * v + c * w;
                }
                for (int m = 0; m < n; m++) {
                    const double a = A[i][m], b = A[k][m];
                    A[i][m] = c * a - s * b, A[k][m] = s * a + c * b;
                }
            }
    }
    for (int k = 0; k < n; k++) values[k] = A[k][k];
}

/* Adds what a vector is beside orthonormal ones. */
void add_direction(Directions *to, int n, const double *vector) {
    double *added = to->line[to->number], size = 0.0;
    memcpy(added, vector, (size_t)n * sizeof(double));
    for (int h = 0; h < to->number; h++) {
        double along = 0.0;
        for (int i = 0; i < n; i++) along += to->line[h][i] * added[i];
        for (int i = 0; i < n; i++) added[i] -= along * to->line[h][i];
    }
    for (int i = 0; i < n; i++) size += added[i] * added[i];
    for (int i = 0; i < n; i++) added[i] /= sqrt(size);
    to->number++;
}

/* span of torchvts/pose/ambiguity.py: the directions that are in one or in the other. */
void join_directions(Directions *one, const Directions *other, int n) {
    double sum[6][6], values[6], vectors[6][6], vector[6];
    for (int i = 0; i < n; i++)
        for (int k = 0; k < n; k++) {
            sum[i][k] = 0.0;
            for (int h = 0; h < one->number; h++) sum[i][k] += one->line[h][i] * one->line[h][k];
            for (int h = 0; h < other->number; h++) sum[i][k] += other->line[h][i] * other->line[h][k];
        }
    eigen_six(sum, 0, n, values, vectors);
    one->number = 0;
    for (int k = 0; k < n; k++) {
        for (int i = 0; i < n; i++) vector[i] = vectors[i][k];
        if (values[k] > 0.25) add_direction(one, n, vector);
    }
}

/* P = I - D D^T */
void beside_directions(const Directions *all, double P[6][6]) {
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 6; k++) {
            P[i][k] = i == k ? 1.0 : 0.0;
            for (int h = 0; h < all->number; h++) P[i][k] -= all->line[h][i] * all->line[h][k];
        }
}

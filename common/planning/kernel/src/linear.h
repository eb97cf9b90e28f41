/* Vectors, rotations (row by row) and poses in doubles. Lengths in [m], angles in [rad]. */
#ifndef ZK_LINEAR_H
#define ZK_LINEAR_H

#include <math.h>

typedef struct {
    double R[9]; /* row by row */
    double p[3];
} pose;

static inline double dot3(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline void cross3(const double *a, const double *b, double *out) {
    double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    out[0] = x, out[1] = y, out[2] = z;
}

static inline void sub3(const double *a, const double *b, double *out) {
    out[0] = a[0] - b[0], out[1] = a[1] - b[1], out[2] = a[2] - b[2];
}

static inline double norm3(const double *a) { return sqrt(dot3(a, a)); }

/* out = R v */
static inline void rotate(const double *R, const double *v, double *out) {
    double x = R[0] * v[0] + R[1] * v[1] + R[2] * v[2];
    double y = R[3] * v[0] + R[4] * v[1] + R[5] * v[2];
    double z = R[6] * v[0] + R[7] * v[1] + R[8] * v[2];
    out[0] = x, out[1] = y, out[2] = z;
}

/* out = R^T v */
static inline void unrotate(const double *R, const double *v, double *out) {
    double x = R[0] * v[0] + R[3] * v[1] + R[6] * v[2];
    double y = R[1] * v[0] + R[4] * v[1] + R[7] * v[2];
    double z = R[2] * v[0] + R[5] * v[1] + R[8] * v[2];
    out[0] = x, out[1] = y, out[2] = z;
}

static inline void act(const pose *T, const double *v, double *out) {
    rotate(T->R, v, out);
    out[0] += T->p[0], out[1] += T->p[1], out[2] += T->p[2];
}

static inline void compose(const pose *A, const pose *B, pose *out) {
    pose C;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            C.R[3 * i + j] = A->R[3 * i] * B->R[j] + A->R[3 * i + 1] * B->R[3 + j] + A->R[3 * i + 2] * B->R[6 + j];
        C.p[i] = dot3(A->R + 3 * i, B->p) + A->p[i];
    }
    *out = C;
}

/* out = A^-1 B */
static inline void relative(const pose *A, const pose *B, pose *out) {
    pose C;
    double d[3] = {B->p[0] - A->p[0], B->p[1] - A->p[1], B->p[2] - A->p[2]};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            C.R[3 * i + j] = A->R[i] * B->R[j] + A->R[3 + i] * B->R[3 + j] + A->R[6 + i] * B->R[6 + j];
    unrotate(A->R, d, C.p);
    *out = C;
}

#endif

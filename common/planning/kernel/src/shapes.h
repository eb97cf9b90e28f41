/* Convex shapes as a core and a rounding radius. GJK needs the core's farthest point in a direction.

   A sphere is a point, a capsule a segment, each with a radius; boxes, cylinders and hulls have none. Dimensions as in
   coal: box full sides; cylinder and capsule radius and length along z; sphere radius. */
#ifndef ZK_SHAPES_H
#define ZK_SHAPES_H

#include <stdlib.h>
#include <string.h>

#include "linear.h"

enum { SPHERE, BOX, CYLINDER, CAPSULE, HULL, POINTS };

typedef double v4 __attribute__((vector_size(32)));
typedef long long i4 __attribute__((vector_size(32)));

typedef struct {
    int kind, joint;
    double size[3];   /* box: half sides; cylinder, capsule: radius, half length */
    double radius;    /* rounding */
    int blocks;       /* of four vertices of a hull */
    v4 *x, *y, *z;    /* the last block repeats a vertex */
    pose placed;      /* in the frame of the joint */
    double middle[3]; /* of a sphere about the shape, in its own frame */
    double sphere;      /* radius of that sphere, rounding included */
    struct points *set; /* of POINTS, in the world; see points.h */
} shape;

#define select4(mask, yes, no) ((v4)(((mask) & (i4)(yes)) | (~(mask) & (i4)(no))))

static inline void hull_support(const shape *s, const double *d, double *out) {
    const v4 *X = s->x, *Y = s->y, *Z = s->z;
    v4 dx = {d[0], d[0], d[0], d[0]}, dy = {d[1], d[1], d[1], d[1]}, dz = {d[2], d[2], d[2], d[2]};
    v4 best = X[0] * dx + Y[0] * dy + Z[0] * dz, other = best;
    i4 at = {0, 0, 0, 0}, at2 = at;
    int n = s->blocks, i = 1;
    for (; i + 1 < n; i += 2) {
        v4 e = X[i] * dx + Y[i] * dy + Z[i] * dz, f = X[i + 1] * dx + Y[i + 1] * dy + Z[i + 1] * dz;
        i4 better = e > best, better2 = f > other;
        i4 here = {i, i, i, i}, next = {i + 1, i + 1, i + 1, i + 1};
        best = select4(better, e, best), at = (better & here) | (~better & at);
        other = select4(better2, f, other), at2 = (better2 & next) | (~better2 & at2);
    }
    if (i < n) {
        v4 e = X[i] * dx + Y[i] * dy + Z[i] * dz;
        i4 better = e > best, here = {i, i, i, i};
        best = select4(better, e, best), at = (better & here) | (~better & at);
    }
    i4 better = other > best;
    best = select4(better, other, best), at = (better & at2) | (~better & at);
    int k = 0;
    double most = best[0];
    if (best[1] > most) most = best[1], k = 1;
    if (best[2] > most) most = best[2], k = 2;
    if (best[3] > most) k = 3;
    int block = (int)at[k];
    out[0] = ((const double *)(X + block))[k];
    out[1] = ((const double *)(Y + block))[k];
    out[2] = ((const double *)(Z + block))[k];
}

/* The core's farthest point in direction d, both in the shape's own frame. */
static inline void support(const shape *s, const double *d, double *out) {
    switch (s->kind) {
    case BOX:
        for (int i = 0; i < 3; i++) out[i] = copysign(s->size[i], d[i]);
        return;
    case CYLINDER: {
        double flat = sqrt(d[0] * d[0] + d[1] * d[1]);
        double k = flat > 1e-300 ? s->size[0] / flat : 0.0;
        out[0] = k * d[0], out[1] = k * d[1], out[2] = copysign(s->size[1], d[2]);
        return;
    }
    case CAPSULE:
        out[0] = out[1] = 0.0, out[2] = copysign(s->size[1], d[2]);
        return;
    case HULL:
        hull_support(s, d, out);
        return;
    default:
        out[0] = out[1] = out[2] = 0.0;
    }
}

/* Distance [m] of a point p outside the shape, and the unit direction to the shape, both in the shape's frame; 0 inside.
   For a hull, the distance of the sphere about it. */
static inline double point_distance(const shape *s, const double *p, double *n) {
    double to[3] = {0, 0, 0}, less = s->radius;
    switch (s->kind) {
    case BOX:
        for (int i = 0; i < 3; i++) {
            double over = fabs(p[i]) - s->size[i];
            to[i] = over > 0 ? -copysign(over, p[i]) : 0.0;
        }
        break;
    case CYLINDER: {
        double flat = sqrt(p[0] * p[0] + p[1] * p[1]), over = flat - s->size[0], up = fabs(p[2]) - s->size[1];
        if (over > 0) to[0] = -p[0] * over / flat, to[1] = -p[1] * over / flat;
        if (up > 0) to[2] = -copysign(up, p[2]);
        break;
    }
    case CAPSULE: {
        double z = p[2] > s->size[1] ? s->size[1] : p[2] < -s->size[1] ? -s->size[1] : p[2];
        to[0] = -p[0], to[1] = -p[1], to[2] = z - p[2];
        break;
    }
    default:
        sub3(s->middle, p, to);
        less = s->sphere;
    }
    double far = norm3(to);
    if (far <= less || far < 1e-12) {
        n[0] = n[1] = 0.0, n[2] = 1.0;
        return far < 1e-12 ? -less : far - less;
    }
    n[0] = to[0] / far, n[1] = to[1] / far, n[2] = to[2] / far;
    return far - less;
}

#endif

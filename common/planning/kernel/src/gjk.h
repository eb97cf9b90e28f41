/* Distance of two convex shapes: Gilbert, Johnson, Keerthi, "A fast procedure for computing the distance between complex
   objects in three-dimensional space" (1988).

   Two bounds hold in spite of rounding: `above`, the distance of two points of the shapes, and `below`, the distance by
   which a plane separates the shapes. "Free" depends on `below` alone. The closest point of a simplex is found region by
   region (as in the signed volumes of Montanari, Petrinic, Barbieri 2017: signs of sub-areas and volumes); for a flat
   simplex all its faces are compared. */
#ifndef ZK_GJK_H
#define ZK_GJK_H

#include "shapes.h"

#define GJK_ITERATIONS 100

typedef struct {
    double w[3], a[3], b[3];
} vertex; /* w = a - b, in the frame of the second shape; a and b on the cores */

typedef struct {
    double above, below; /* [m], of the rounded shapes; below is negative if no plane was found */
    double n[3];         /* unit, from the first to the second, of the plane that gave `below`; frame of the second */
    double a[3], b[3];   /* nearest points of the cores, frame of the second */
    int iterations;
} gjk_answer;

typedef struct {
    int count, index[4];
    double weight[4], v[3], square;
} closest;

static inline void on_point(const vertex *s, int i, closest *c) {
    c->count = 1, c->index[0] = i, c->weight[0] = 1.0;
    memcpy(c->v, s[i].w, sizeof c->v);
    c->square = dot3(c->v, c->v);
}

static inline void on_segment(const vertex *s, int i, int j, closest *c) {
    double d[3];
    sub3(s[j].w, s[i].w, d);
    double length = dot3(d, d), t = -dot3(s[i].w, d);
    if (t <= 0 || length <= 0) {
        on_point(s, i, c);
        return;
    }
    if (t >= length) {
        on_point(s, j, c);
        return;
    }
    t /= length;
    c->count = 2, c->index[0] = i, c->index[1] = j, c->weight[0] = 1 - t, c->weight[1] = t;
    for (int k = 0; k < 3; k++) c->v[k] = s[i].w[k] + t * d[k];
    c->square = dot3(c->v, c->v);
}

static inline void on_triangle(const vertex *s, int i, int j, int k, closest *c) {
    const double *a = s[i].w, *b = s[j].w, *d = s[k].w;
    double ab[3], ad[3], bd[3], n[3], x[3];
    sub3(b, a, ab), sub3(d, a, ad), sub3(d, b, bd);
    cross3(ab, ad, n);
    double area = dot3(n, n);
    double la = dot3(ab, ab), ld = dot3(ad, ad);
    double wa = -1, wb = -1, wd = -1;
    if (area > 1e-24 * la * ld) {
        cross3(bd, b, x), wa = -dot3(n, x) / area; /* n . ((d - b) x (0 - b)) */
        cross3(ad, a, x), wb = dot3(n, x) / area;  /* n . ((a - d) x (0 - d)) */
        cross3(ab, a, x), wd = -dot3(n, x) / area;
        if (wa > 0 && wb > 0 && wd > 0) {
            double h = dot3(a, n) / area, sum = wa + wb + wd;
            c->count = 3, c->index[0] = i, c->index[1] = j, c->index[2] = k;
            c->weight[0] = wa / sum, c->weight[1] = wb / sum, c->weight[2] = wd / sum;
            for (int m = 0; m < 3; m++) c->v[m] = h * n[m];
            c->square = dot3(c->v, c->v);
            return;
        }
    }
    closest e;
    c->square = INFINITY;
    if (wd <= 0) on_segment(s, i, j, c);
    if (wb <= 0) {
        on_segment(s, i, k, &e);
        if (e.square < c->square) *c = e;
    }
    if (wa <= 0) {
        on_segment(s, j, k, &e);
        if (e.square < c->square) *c = e;
    }
}

static inline void on_tetrahedron(const vertex *s, closest *c) {
    static const int faces[4][4] = {{3, 0, 1, 2}, {3, 1, 2, 0}, {3, 2, 0, 1}, {0, 1, 2, 3}}; /* face, opposite vertex */
    closest e;
    int outside = 0;
    c->square = INFINITY;
    for (int f = 0; f < 4; f++) {
        const int *g = faces[f];
        double u[3], v[3], o[3], n[3];
        sub3(s[g[1]].w, s[g[0]].w, u), sub3(s[g[2]].w, s[g[0]].w, v), sub3(s[g[3]].w, s[g[0]].w, o);
        cross3(u, v, n);
        double size = sqrt(dot3(n, n) * dot3(o, o));
        double opposite = dot3(n, o), origin = -dot3(n, s[g[0]].w);
        int flat = fabs(opposite) <= 1e-13 * size;
        if (!flat && opposite * origin > 0) continue;
        outside = 1;
        on_triangle(s, g[0], g[1], g[2], &e);
        if (e.square < c->square) *c = e;
    }
    if (!outside) c->count = 4, c->square = 0.0, c->v[0] = c->v[1] = c->v[2] = 0.0;
}

/* The distance of A from B, whose frame is that of `T_b_a`.

   begin: unit direction (frame of B) to start with, from A to B.
   enough: stop when `below` is more than this [m]; near: stop when `above` is at most this [m].
   share: stop when `below` is this share of the distance from `near` to `above`; 1: converge completely. */
static inline void gjk(const shape *A, const shape *B, const pose *T_b_a, const double *begin, double enough, double near,
                       double share, gjk_answer *out) {
    vertex s[4];
    closest c = {0};
    int count = 0;
    double radii = A->radius + B->radius;
    double n[3] = {begin[0], begin[1], begin[2]};
    double length = INFINITY;
    out->above = INFINITY, out->below = -INFINITY;
    out->iterations = 0;
    for (int iteration = 0; iteration < GJK_ITERATIONS; iteration++) {
        vertex w;
        double d[3], m[3] = {-n[0], -n[1], -n[2]};
        out->iterations++;
        unrotate(T_b_a->R, n, d);
        support(A, d, w.a);
        act(T_b_a, w.a, w.a);
        support(B, m, w.b);
        sub3(w.a, w.b, w.w);
        double below = -dot3(n, w.w) - radii;
        if (below > out->below) {
            out->below = below;
            memcpy(out->n, n, sizeof n);
            if (below > enough) break;
        }
        if (iteration) {
            double rest = out->above - out->below;
            if (rest <= 1e-12) break;
            if (share < 1 && out->below > near && out->below - near >= share * (out->above - near)) break;
            int known = 0;
            for (int i = 0; i < count; i++)
                if (w.w[0] == s[i].w[0] && w.w[1] == s[i].w[1] && w.w[2] == s[i].w[2]) known = 1;
            if (known) break;
        }
        s[count++] = w;
        switch (count) {
        case 1:
            on_point(s, 0, &c);
            break;
        case 2:
            on_segment(s, 1, 0, &c);
            break;
        case 3:
            on_triangle(s, 2, 0, 1, &c);
            break;
        default:
            on_tetrahedron(s, &c);
        }
        if (c.count == 4) {
            out->above = -radii;
            if (out->below > 0) out->below = 0; /* by rounding only */
            break;
        }
        double now = sqrt(c.square);
        if (!(now < length)) break; /* rounding ended the progress */
        length = now;
        vertex used[4];
        for (int i = 0; i < c.count; i++) used[i] = s[c.index[i]];
        memcpy(s, used, sizeof(vertex) * c.count);
        count = c.count;
        out->above = length - radii;
        for (int k = 0; k < 3; k++) {
            out->a[k] = out->b[k] = 0;
            for (int i = 0; i < count; i++)
                out->a[k] += c.weight[i] * s[i].a[k], out->b[k] += c.weight[i] * s[i].b[k];
        }
        if (out->above <= near || length < 1e-11) break;
        for (int k = 0; k < 3; k++) n[k] = -c.v[k] / length;
    }
    /* If only the roundings overlap, the cores are apart, so the negative distance is known, too. */
}

#endif

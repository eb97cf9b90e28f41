/* Whether a piece of a joint-space curve is free all along, proved and not sampled.

   Of a pair at time t0 a plane with normal n holds the shapes apart by s0. Later the plane, moved along, still holds them
   apart by at least

       s(t) = s0 - v (t - t0) - K (t - t0)^2 / 2,

   where v is the speed at which points of a approach the plane at t0 (from the twists of the two bodies, relative to the
   last joint that moves both) and K bounds the acceleration of any of their points on the whole curve: with the axes a_j
   of the joints up to a shape, p'' = sum over j, k of q'_j q'_k a_min(j,k) x (a_max(j,k) x (p - o)) + sum of
   q''_k a_k x (p - o), so K = sum over j, k of |q'_j| |q'_k| L_max(j,k) + sum of |q''_k| L_k with the levers L. The same
   holds without the direction: s(t) = s0 - M |t - t0| with M = sum of |q'_k| L_k. So each look at a pair proves an
   interval about t0. What is left is looked at again in the middle, the likeliest collisions first. */
#ifndef ZK_EDGES_H
#define ZK_EDGES_H

#include "world.h"

#define SHORTEST_MOTION 1e-6 /* [m] no piece is cut in which no point moves farther: what is not proved then is not free */

/* q(t) = c[0] + c[1] t + c[2] t^2 + c[3] t^3, 0 <= t <= 1 */
typedef struct {
    double c[4][MOST_JOINTS];
    double speed[MOST_JOINTS], bend[MOST_JOINTS]; /* largest |q'| and |q''| */
} curve;

typedef struct span {
    double from, to;
    int first, count; /* pairs that are not proved in it, in the list */
} span;

static void line_curve(int dof, const double *a, const double *b, curve *out) {
    for (int j = 0; j < dof; j++) {
        out->c[0][j] = a[j], out->c[1][j] = b[j] - a[j], out->c[2][j] = out->c[3][j] = 0.0;
        out->speed[j] = fabs(b[j] - a[j]), out->bend[j] = 0.0;
    }
}

static void cubic_curve(int dof, const double *c, curve *out) {
    for (int j = 0; j < dof; j++) {
        double c1 = c[dof + j], c2 = c[2 * dof + j], c3 = c[3 * dof + j];
        for (int k = 0; k < 4; k++) out->c[k][j] = c[k * dof + j];
        out->bend[j] = fmax(fabs(2 * c2), fabs(2 * c2 + 6 * c3));
        out->speed[j] = fmax(fabs(c1), fabs(c1 + 2 * c2 + 3 * c3));
        double turn = c3 != 0.0 ? -c2 / (3 * c3) : -1.0; /* where the velocity of a cubic has its extreme */
        if (turn > 0 && turn < 1) out->speed[j] = fmax(out->speed[j], fabs(c1 + turn * (2 * c2 + 3 * c3 * turn)));
    }
}

/* M and K of a shape relative to the body of a joint above it. */
static inline void bounds(const world *w, const curve *e, int tip, int above, const double *lever, double *M, double *K) {
    const joint *J = &w->joint[tip];
    double before = 0, first = 0, second = 0;
    for (int k = w->joint[above].depth; k < J->depth; k++) {
        int j = J->chain[k];
        double v = e->speed[j - 1];
        first += v * lever[j];
        second += v * (v + 2 * before) * lever[j] + e->bend[j - 1] * lever[j];
        before += w->joint[j].kind == REVOLUTE ? v : 0.0;
    }
    *M = first, *K = second;
}

/* How long s0 - v t - K t^2 / 2 or s0 - M t stays positive. */
static inline double lasts(double s0, double v, double K, double M) {
    double root = sqrt(v * v + 2 * K * s0), curved;
    if (v > 0)
        curved = 2 * s0 / (v + root);
    else
        curved = K > 1e-300 ? (root - v) / K : INFINITY;
    double plain = M > 1e-300 ? s0 / M : INFINITY;
    return curved > plain ? curved : plain;
}

/* Speed of the point at x (world) of a body that moves relative to another, along n. */
static inline double speed_at(const double *spin, const double *slide, const double *x, const double *n) {
    double u[3];
    cross3(spin, x, u);
    return n[0] * (u[0] + slide[0]) + n[1] * (u[1] + slide[1]) + n[2] * (u[2] + slide[2]);
}

/* Largest speed along n, times sign, of any core point of a shape. */
static inline double shape_speed(scratch *c, int i, const double *spin, const double *slide, const double *n, double sign) {
    const shape *s = &c->w->shape[i];
    const pose *T = shape_pose(c, i);
    double m[3], local[3], p[3];
    cross3(n, spin, m);
    for (int k = 0; k < 3; k++) m[k] *= sign;
    unrotate(T->R, m, local);
    support(s, local, p);
    act(T, p, p);
    return sign * dot3(n, slide) + dot3(m, p);
}

/* The interval about t0 in which a pair keeps its margin; 0 where it does not at t0. After forward, twists, middles. */
static int proved(scratch *c, const curve *e, int i, double margin, double t0, double from, double to, double *since,
                  double *until) {
    const world *w = c->w;
    const pair *p = &w->pair[i];
    const shape *A = &w->shape[p->a], *B = &w->shape[p->b];
    double M, K, Mb = 0, Kb = 0, need = margin + TOUCHING;
    double spin[3], slide[3], spin_b[3] = {0}, slide_b[3] = {0}, n[3];
    c->checks++;
    sub3(c->spin[A->joint], c->spin[p->common], spin);
    sub3(c->slide[A->joint], c->slide[p->common], slide);
    if (!p->fixed) {
        sub3(c->spin[B->joint], c->spin[p->common], spin_b);
        sub3(c->slide[B->joint], c->slide[p->common], slide_b);
        bounds(w, e, B->joint, p->common, w->reach[p->b], &Mb, &Kb);
    }
    double s0 = ball_distance(c, p, n) - need;
    *since = *until = t0;
    if (s0 > 0) {
        bounds(w, e, A->joint, p->common, w->reach[p->a], &M, &K);
        double v = speed_at(spin, slide, c->middle[p->a], n);
        if (!p->fixed) v -= speed_at(spin_b, slide_b, c->middle[p->b], n);
        *until = t0 + lasts(s0, v, K + Kb, M + Mb);
        *since = t0 - lasts(s0, -v, K + Kb, M + Mb);
        if (*since <= from && *until >= to) return 1;
    }
    gjk_answer found;
    bounds(w, e, A->joint, p->common, w->lever[p->a], &M, &K);
    if (!p->fixed) bounds(w, e, B->joint, p->common, w->lever[p->b], &Mb, &Kb);
    M += Mb, K += Kb;
    double half = fmax(to - t0, t0 - from);
    pair_distance(c, i, need + half * M, margin, 0.9, &found);
    s0 = found.below - need;
    if (s0 <= 0) return *until > t0;
    rotate(shape_pose(c, p->b)->R, found.n, n);
    for (int side = 0; side < 2; side++) {
        double sign = side ? -1.0 : 1.0;
        double v = shape_speed(c, p->a, spin, slide, n, sign);
        if (!p->fixed) v += shape_speed(c, p->b, spin_b, slide_b, n, -sign);
        double t = lasts(s0, v, K, M);
        if (side)
            *since = fmin(*since, t0 - t);
        else
            *until = fmax(*until, t0 + t);
    }
    return 1;
}

static int grow(scratch *c, int list, int spans) {
    if (list > c->list_room) {
        int *more = realloc(c->list, sizeof(int) * 2 * list);
        if (!more) return 0;
        c->list = more, c->list_room = 2 * list;
    }
    if (spans > c->span_room) {
        span *more = realloc(c->span, sizeof(span) * 2 * spans);
        if (!more) return 0;
        c->span = more, c->span_room = 2 * spans;
    }
    return 1;
}

static void at_time(const world *w, const curve *e, double t, double *q, double *dq) {
    for (int j = 0; j < w->dof; j++) {
        double c1 = e->c[1][j], c2 = e->c[2][j], c3 = e->c[3][j];
        q[j] = e->c[0][j] + t * (c1 + t * (c2 + t * c3));
        dq[j] = c1 + t * (2 * c2 + t * 3 * c3);
    }
}

/* Whether the whole curve is free. Else `hit_pair` and `hit_at` say what touches or cannot be proved, and where. */
static int curve_free(scratch *c, const curve *e) {
    const world *w = c->w;
    double q[MOST_JOINTS], dq[MOST_JOINTS];
    double most = 0; /* how fast any point moves */
    for (int i = 0; i < w->shapes; i++)
        if (w->shape[i].joint) {
            double M, K;
            bounds(w, e, w->shape[i].joint, 0, w->lever[i], &M, &K);
            most = fmax(most, M);
        }
    double M_tip = 0, K_tip = 0;
    if (w->excuses) bounds(w, e, w->tool, 0, w->tip_lever, &M_tip, &K_tip);
    int used = 0, head = 0, tail = 1;
    if (!grow(c, w->pairs, 64)) return 0;
    for (int k = 0; k < w->pairs; k++)
        if (w->far[c->order[k]] > EXCUSED || w->near[c->order[k]] > EXCUSED) c->list[used++] = c->order[k];
    c->span[0] = (span){0.0, 1.0, 0, used};
    while (head < tail) {
        span s = c->span[head++];
        double t0 = 0.5 * (s.from + s.to);
        at_time(w, e, t0, q, dq);
        forward(c, q);
        twists(c, dq);
        middles(c);
        double inside = 0; /* how long the tool surely stays within, negative: beyond, its leash */
        if (w->excuses) inside = w->leash - tool_travel(c);
        if (!grow(c, used + 2 * s.count, tail + 2)) return 0;
        int left = used, lefts = 0, right = used + s.count, rights = 0;
        double until_left = s.from, since_right = s.to;
        for (int k = 0; k < s.count; k++) {
            int i = c->list[s.first + k];
            double since = t0, until = t0, a, b;
            if (w->excuses && w->near[i] != w->far[i]) {
                /* the larger margin first; where only the smaller one is kept, as long as that one counts */
                double large = fmax(w->near[i], w->far[i]), small = fmin(w->near[i], w->far[i]);
                double counting = inside > 0 ? w->near[i] : w->far[i];
                int ok = proved(c, e, i, large, t0, s.from, s.to, &since, &until);
                if (counting == small && !(ok && since <= s.from && until >= s.to)) {
                    double time = M_tip > 0 ? fabs(inside) / M_tip : INFINITY;
                    int also = small <= EXCUSED;
                    a = -INFINITY, b = INFINITY;
                    if (!also) also = proved(c, e, i, small, t0, s.from, s.to, &a, &b);
                    if (also) {
                        since = fmin(since, fmax(a, t0 - time)), until = fmax(until, fmin(b, t0 + time));
                        ok = 1;
                    }
                }
                if (!ok) {
                    c->hit_pair = i, c->hit_at = t0;
                    to_front(c, i);
                    return 0;
                }
            } else if (!proved(c, e, i, w->far[i], t0, s.from, s.to, &since, &until)) {
                c->hit_pair = i, c->hit_at = t0;
                to_front(c, i);
                return 0;
            }
            if (since > s.from) {
                c->list[left + lefts++] = i;
                until_left = fmax(until_left, fmin(since, t0));
            }
            if (until < s.to) {
                c->list[right + rights++] = i;
                since_right = fmin(since_right, fmax(until, t0));
            }
        }
        if ((lefts || rights) && 0.5 * (s.to - s.from) * most < SHORTEST_MOTION) {
            c->hit_pair = lefts ? c->list[left] : c->list[right], c->hit_at = t0;
            to_front(c, c->hit_pair);
            return 0;
        }
        if (lefts) c->span[tail++] = (span){s.from, until_left, left, lefts};
        if (rights) c->span[tail++] = (span){since_right, s.to, right, rights};
        used = rights ? right + rights : left + lefts;
    }
    return 1;
}

#endif

/* Proves that a complete joint-space curve is free, without sampling.

   At time t0 a plane with normal n separates the shapes of a pair by s0. Later the moved plane still separates them by at
   least

       s(t) = s0 - v (t - t0) - K (t - t0)^2 / 2,

   where v is the speed at which points of a approach the plane at t0 (from the twists of the two bodies, relative to the
   last joint that moves both) and K bounds the acceleration of any of their points on the whole curve: with the axes a_j
   of the joints up to a shape, p'' = sum over j, k of q'_j q'_k a_min(j,k) x (a_max(j,k) x (p - o)) + sum of
   q''_k a_k x (p - o), so K = sum over j, k of |q'_j| |q'_k| L_max(j,k) + sum of |q''_k| L_k with the levers L. The same
   holds without the direction: s(t) = s0 - M |t - t0| with M = sum of |q'_k| L_k. So each check of a pair proves an
   interval about t0. The remaining intervals are checked in their middles, the most likely collisions first. */
#ifndef ZK_EDGES_H
#define ZK_EDGES_H

#include "world.h"

#define FARTHEST 1e4           /* [rad], [m] a curve that leads farther away, or is not finite, is not free */
#define SHORTEST_MOTION 1e-6 /* [m] pieces in which no point moves farther are not divided: unproved ones are not free */

/* Tuned by processor time on the benchmarks' edges; correctness does not depend on them. */
#define GROUP_SHARE 0.05      /* a group's sphere that proves less of a span is replaced by its pairs */
#define PAIR_SHARE 0.3  /* and a pair's sphere by its shapes */
#define SHARE 0.7      /* of the distance that is enough: GJK stops there */
#define ACCEPT 0.7     /* of what the nearest spheres leave of a span: a node that proves as much is not descended */
#define PROBES 7       /* positions on an edge at which the last collisions are checked first */

/* q(t) = c[0] + c[1] t + c[2] t^2 + c[3] t^3, 0 <= t <= 1 */
typedef struct {
    double c[4][MAX_JOINTS];
    double speed[MAX_JOINTS], bend[MAX_JOINTS]; /* largest |q'| and |q''| */
    double beyond; /* [m] bound of how far joints slide out of their limits, which lengthens levers */
} curve;

typedef struct span {
    double from, to;
    int first, count; /* unproved pairs, in the list */
} span;

/* How far [m] positions as large as |q| exceed the stroke of a sliding joint. */
static inline double beyond_stroke(const world *w, int j, double q) {
    return w->joint[j + 1].kind == PRISMATIC ? fmax(fabs(q) - w->stroke[j + 1], 0.0) : 0.0;
}

static void line_curve(const world *w, const double *a, const double *b, curve *out) {
    out->beyond = 0;
    for (int j = 0; j < w->dof; j++) {
        out->c[0][j] = a[j], out->c[1][j] = b[j] - a[j], out->c[2][j] = out->c[3][j] = 0.0;
        out->speed[j] = fabs(b[j] - a[j]), out->bend[j] = 0.0;
        out->beyond += beyond_stroke(w, j, fmax(fabs(a[j]), fabs(b[j])));
    }
}

static void cubic_curve(const world *w, const double *c, curve *out) {
    int dof = w->dof;
    out->beyond = 0;
    for (int j = 0; j < dof; j++) {
        double c1 = c[dof + j], c2 = c[2 * dof + j], c3 = c[3 * dof + j];
        for (int k = 0; k < 4; k++) out->c[k][j] = c[k * dof + j];
        out->bend[j] = fmax(fabs(2 * c2), fabs(2 * c2 + 6 * c3));
        out->speed[j] = fmax(fabs(c1), fabs(c1 + 2 * c2 + 3 * c3));
        double most = fabs(c[j]) + fabs(c1) + fabs(c2) + fabs(c3);
        out->beyond += beyond_stroke(w, j, most);
        double turn = c3 != 0.0 ? -c2 / (3 * c3) : -1.0; /* where the velocity of a cubic is extreme */
        if (turn > 0 && turn < 1) out->speed[j] = fmax(out->speed[j], fabs(c1 + turn * (2 * c2 + 3 * c3 * turn)));
    }
}

/* M and K of a shape relative to the body of a joint above it. */
static inline void bounds(const world *w, const curve *e, int tip, int above, const double *lever, double *M, double *K) {
    const joint *J = &w->joint[tip];
    double before = 0, first = 0, second = 0;
    for (int k = w->joint[above].depth; k < J->depth; k++) {
        int j = J->chain[k];
        double v = e->speed[j - 1], far = lever[j] + e->beyond;
        first += v * far;
        second += v * (v + 2 * before) * far + e->bend[j - 1] * far;
        before += w->joint[j].kind == REVOLUTE ? v : 0.0;
    }
    *M = first, *K = second;
}

/* How long s0 - v t - K t^2 / 2 or s0 - M t stays positive, the longer of both. */
static inline double time_to_zero(double s0, double v, double K, double M) {
    double root = sqrt(v * v + 2 * K * s0), curved;
    if (v > 0)
        curved = 2 * s0 / (v + root);
    else
        curved = K > 1e-300 ? (root - v) / K : INFINITY;
    double plain = M > 1e-300 ? s0 / M : INFINITY;
    double most = curved > plain ? curved : plain;
    return most > 0 ? most : 0.0;
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

/* Twist of one joint's body relative to another's. */
static inline void relative_twist(const scratch *c, int tip, int above, double *spin, double *slide) {
    sub3(c->spin[tip], c->spin[above], spin);
    sub3(c->slide[tip], c->slide[above], slide);
}

/* A body that moves towards a set of points: a sphere, and the shape in it if required. */
typedef struct {
    int shape; /* -1: the sphere alone */
    const double *middle, *spin, *slide, *bound; /* M and K of the sphere's middle, then of the shape */
    double sphere;
} mover;

/* Sets the interval about t0, within `from` to `to`, in which all spheres of a set stay farther than `need` from a mover;
   0 if one does not at t0. Each node's sphere is convex, so a plane separates everything inside it. */
static int points_proved(scratch *c, const struct points *set, const mover *m, double *axis, double need, double t0,
                         double from, double to, double *since, double *until, int *hit) {
    const shape *A = m->shape < 0 ? NULL : &c->w->shape[m->shape];
    const pose *T = A ? shape_pose(c, m->shape) : NULL;
    double lo = from, hi = to, least_lo = from, least_hi = to; /* limits by spheres themselves, and by nodes for all below */
    visit stack[DEEPEST] = {{0, {axis[0], axis[1], axis[2]}}};
    int top = set && set->count ? 1 : 0;
    while (top) {
        visit v = stack[--top];
        const sphere_node *b = &set->node[v.node];
        double n[3], a = t0, z = t0, s0 = spheres_apart(m->middle, m->sphere, b->c, b->r, n) - need;
        if (s0 > 0) {
            double speed = speed_at(m->spin, m->slide, m->middle, n);
            z = t0 + time_to_zero(s0, speed, m->bound[1], m->bound[0]);
            a = t0 - time_to_zero(s0, -speed, m->bound[1], m->bound[0]);
            if (a <= lo && z >= hi) continue;
        }
        if (A && (!b->right || b->r < A->sphere)) {
            double M = m->bound[2], K = m->bound[3], ahead = hi - t0, back = t0 - lo;
            double speed = speed_at(m->spin, m->slide, m->middle, v.n);
            double wanted = fmax(ahead * (speed + 0.5 * K * ahead), back * (0.5 * K * back - speed));
            wanted = fmax(fmin(wanted, fmax(ahead, back) * M), 0.0);
            gjk_answer found;
            node_distance(A, T, b, v.n, need + 1.01 * wanted, need, SHARE, &found);
            c->searches++, c->iterations += found.iterations;
            if (found.below > -1e9) memcpy(v.n, found.n, sizeof v.n), memcpy(axis, found.n, sizeof v.n);
            s0 = found.below - need;
            if (s0 > 0) {
                z = fmax(z, t0 + time_to_zero(s0, shape_speed(c, m->shape, m->spin, m->slide, v.n, 1.0), K, M));
                a = fmin(a, t0 - time_to_zero(s0, shape_speed(c, m->shape, m->spin, m->slide, v.n, -1.0), K, M));
                if (a <= lo && z >= hi) continue;
            }
        }
        int leaf = !b->right;
        if (leaf && !(z > t0)) {
            *hit = v.node;
            return 0;
        }
        if (leaf) least_lo = fmax(least_lo, a), least_hi = fmin(least_hi, z);
        if (leaf || (z - t0 >= ACCEPT * (least_hi - t0) && t0 - a >= ACCEPT * (t0 - least_lo) && z > t0)) {
            lo = fmax(lo, a), hi = fmin(hi, z);
            continue;
        }
        top = push_children(set->node, &v, m->middle, m->sphere, INFINITY, stack, top);
    }
    *since = lo, *until = hi;
    return 1;
}

/* Sets the interval about t0 in which a group's spheres keep its margin; 0 if they do not at t0. Call after forward,
   twists, middles. */
static int group_proved(scratch *c, const curve *e, const group *g, double margin, double t0, double from, double to,
                        double *since, double *until) {
    const world *w = c->w;
    const pair *p = &g->spheres;
    double n[3], spin[3], slide[3], M, K, Mb = 0, Kb = 0;
    c->checks++;
    *since = *until = t0;
    if (!g->moving && w->shape[p->b].kind == POINTS) {
        double bound[2], axis[3] = {0, 0, 1};
        int hit;
        relative_twist(c, p->a, 0, spin, slide);
        bounds(w, e, p->a, 0, w->body[p->a].reach, &bound[0], &bound[1]);
        mover m = {-1, c->body_middle[p->a], spin, slide, bound, w->body[p->a].sphere};
        return points_proved(c, w->shape[p->b].set, &m, axis, margin + TOUCHING, t0, from, to, since, until, &hit);
    }
    double s0 = group_apart(c, g, n) - margin - TOUCHING;
    if (!(s0 > 0)) return 0;
    relative_twist(c, p->a, p->common, spin, slide);
    double v = speed_at(spin, slide, c->body_middle[p->a], n);
    bounds(w, e, p->a, p->common, w->body[p->a].reach, &M, &K);
    if (g->moving && !p->fixed) {
        relative_twist(c, p->b, p->common, spin, slide);
        v -= speed_at(spin, slide, c->body_middle[p->b], n);
        bounds(w, e, p->b, p->common, w->body[p->b].reach, &Mb, &Kb);
    }
    *until = t0 + time_to_zero(s0, v, K + Kb, M + Mb);
    *since = t0 - time_to_zero(s0, -v, K + Kb, M + Mb);
    return 1;
}

/* M and K of a pair's spheres and of its shapes on a curve. */
static void pair_bounds(scratch *c, const curve *e, int i) {
    const world *w = c->w;
    const pair *p = &w->pair[i];
    double *out = c->bound[i], M, K;
    int tip = w->shape[p->a].joint;
    bounds(w, e, tip, p->common, w->reach[p->a], &out[0], &out[1]);
    bounds(w, e, tip, p->common, w->lever[p->a], &out[2], &out[3]);
    if (p->fixed) return;
    tip = w->shape[p->b].joint;
    bounds(w, e, tip, p->common, w->reach[p->b], &M, &K);
    out[0] += M, out[1] += K;
    bounds(w, e, tip, p->common, w->lever[p->b], &M, &K);
    out[2] += M, out[3] += K;
}

/* The same of a pair, first by the sphere of its first shape and then by the shapes. */
static int proved(scratch *c, int i, double margin, double t0, double from, double to, double *since, double *until) {
    const world *w = c->w;
    const pair *p = &w->pair[i];
    const shape *A = &w->shape[p->a], *B = &w->shape[p->b];
    const double *bound = c->bound[i];
    double spin[3], slide[3], spin_b[3] = {0}, slide_b[3] = {0}, n[3], need = margin + TOUCHING;
    c->checks++;
    relative_twist(c, A->joint, p->common, spin, slide);
    if (B->kind == POINTS) {
        mover m = {p->a, c->middle[p->a], spin, slide, bound, A->sphere};
        *since = *until = t0;
        return points_proved(c, B->set, &m, c->axis[i], need, t0, from, to, since, until, &c->touched[i]);
    }
    if (!p->fixed) relative_twist(c, B->joint, p->common, spin_b, slide_b);
    double s0 = pair_apart(c, p, n) - need;
    *since = *until = t0;
    if (s0 > 0) {
        double v = speed_at(spin, slide, c->middle[p->a], n);
        if (!p->fixed) v -= speed_at(spin_b, slide_b, c->middle[p->b], n);
        *until = t0 + time_to_zero(s0, v, bound[1], bound[0]);
        *since = t0 - time_to_zero(s0, -v, bound[1], bound[0]);
        int small = (to - from) * bound[2] < 100 * SHORTEST_MOTION; /* near the end of the division the shapes decide */
        if (*since <= from && *until >= to) return 1;
        if (!small && fmin(*until, to) - fmax(*since, from) > PAIR_SHARE * (to - from)) return 1;
    }
    double M = bound[2], K = bound[3], v, wanted = 0, ahead = to - t0, back = t0 - from;
    rotate(shape_pose(c, p->b)->R, c->axis[i], n); /* estimate of the required distance */
    v = speed_at(spin, slide, c->middle[p->a], n);
    if (!p->fixed) v -= speed_at(spin_b, slide_b, c->middle[p->b], n);
    wanted = fmax(ahead * (v + 0.5 * K * ahead), back * (0.5 * K * back - v));
    wanted = fmax(fmin(wanted, fmax(ahead, back) * M), 0.0);
    gjk_answer found;
    pair_distance(c, i, need + 1.01 * wanted, margin, SHARE, &found);
    s0 = found.below - need;
    if (s0 <= 0) return *until > t0;
    rotate(shape_pose(c, p->b)->R, found.n, n);
    for (int side = 0; side < 2; side++) {
        double sign = side ? -1.0 : 1.0;
        if (side ? *since <= from : *until >= to) continue;
        v = shape_speed(c, p->a, spin, slide, n, sign);
        if (!p->fixed) v += shape_speed(c, p->b, spin_b, slide_b, n, -sign);
        double t = time_to_zero(s0, v, K, M);
        if (side)
            *since = fmin(*since, t0 - t);
        else
            *until = fmax(*until, t0 + t);
    }
    return 1;
}

/* The same for a pair whose margin changes with the distance of the tool from its start: by the larger margin, and by the
   smaller one while it applies. inside: what the tool has left of contact_distance [m]; tip: M of the tool point. */
static int proved_near_start(scratch *c, int i, double inside, double tip, double t0, double from, double to, double *since,
                          double *until) {
    const world *w = c->w;
    double large = fmax(w->near[i], w->far[i]), small = fmin(w->near[i], w->far[i]);
    int ok = proved(c, i, large, t0, from, to, since, until);
    if ((inside > 0 ? w->near[i] : w->far[i]) != small || (ok && *since <= from && *until >= to)) return ok;
    double time = tip > 0 ? fabs(inside) / tip : INFINITY, a = -INFINITY, b = INFINITY;
    if (small > CONTACT_ALLOWED && !proved(c, i, small, t0, from, to, &a, &b)) return ok;
    *since = fmin(*since, fmax(a, t0 - time)), *until = fmax(*until, fmin(b, t0 + time));
    return 1;
}

#define MAX_ENTRIES (1 << 26)
#define MAX_SPANS (1 << 24)

static int grow(scratch *c, int list, int spans) {
    if (list > MAX_ENTRIES || spans > MAX_SPANS) return 0;
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

/* Unproved entries of a span for its two halves. */
typedef struct {
    int *list, lefts, rights;
    double from, to, until_left, since_right;
} halves;

static inline void leave(halves *h, int right, int entry, double since, double until, double t0) {
    if (since > h->from) {
        h->list[h->lefts++] = entry;
        h->until_left = fmax(h->until_left, fmin(since, t0));
    }
    if (until < h->to) {
        h->list[right + h->rights++] = entry;
        h->since_right = fmin(h->since_right, fmax(until, t0));
    }
}

/* Whether a few states of a curve are free of the collisions found last. */
static int probes_free(scratch *c, const curve *e) {
    static const double times[PROBES] = {0.5, 0.25, 0.75, 0.875, 0.125, 0.625, 0.375};
    const world *w = c->w;
    double q[MAX_JOINTS], dq[MAX_JOINTS];
    if (c->hot[0] < 0) return 1;
    for (int k = 0; k < PROBES; k++) {
        at_time(w, e, times[k], q, dq);
        forward(c, q);
        middles(c);
        const double *margin = w->near_differs && tool_travel(c) < w->contact_distance ? w->near : w->far;
        if (hot_free(c, margin)) continue;
        c->hit_at = times[k];
        return 0;
    }
    return 1;
}

/* Whether the complete curve is free. Else `hit_pair` and `hit_at` are the pair that touches or is unproved, and where. */
static int curve_free(scratch *c, const curve *e) {
    const world *w = c->w;
    double q[MAX_JOINTS], dq[MAX_JOINTS], most = 0; /* how fast any point moves */
    double far = 0;
    c->edges++;
    for (int j = 0; j < w->dof; j++)
        for (int k = 0; k < 4; k++) far += fabs(e->c[k][j]);
    c->hit_at = 0;
    if (!(far < FARTHEST)) return 0;
    if (!probes_free(c, e)) return 0;
    for (int i = 0; i < w->shapes; i++)
        if (w->shape[i].joint) {
            double M, K;
            bounds(w, e, w->shape[i].joint, 0, w->lever[i], &M, &K);
            most = fmax(most, M);
        }
    double M_tip = 0, K_tip = 0;
    if (w->near_differs) bounds(w, e, w->tool, 0, w->tip_lever, &M_tip, &K_tip);
    int used = 0, head = 0, tail = 1;
    if (!grow(c, w->groups, 64)) return 0;
    for (int g = 0; g < w->groups; g++) /* entries below zero are groups */
        if (w->group[g].far > CONTACT_ALLOWED || w->group[g].near > CONTACT_ALLOWED) c->list[used++] = -1 - g;
    c->span[0] = (span){0.0, 1.0, 0, used};
    while (head < tail) {
        span s = c->span[head++];
        double t0 = 0.5 * (s.from + s.to), since, until;
        at_time(w, e, t0, q, dq);
        forward(c, q);
        twists(c, dq);
        middles(c);
        double inside = 0; /* what the tool has left of contact_distance */
        if (w->near_differs) inside = w->contact_distance - tool_travel(c);
        int most_pairs = s.count + w->pairs; /* that can remain */
        if (!grow(c, used + 2 * most_pairs, tail + 2)) return 0;
        int right = most_pairs;
        halves h = {c->list + used, 0, 0, s.from, s.to, s.from, s.to};
        for (int k = 0; k < s.count; k++) {
            int entry = c->list[s.first + k], first = entry, count = 1;
            const int *members = &first;
            if (entry < 0) {
                const group *g = &w->group[-1 - entry];
                if (group_proved(c, e, g, fmax(g->far, g->near), t0, s.from, s.to, &since, &until)) {
                    if (since <= s.from && until >= s.to) continue;
                    int small = (s.to - s.from) * most < 100 * SHORTEST_MOTION;
                    if (!small && fmin(until, s.to) - fmax(since, s.from) > GROUP_SHARE * (s.to - s.from)) {
                        leave(&h, right, entry, since, until, t0);
                        continue;
                    }
                }
                members = w->member + g->first, count = g->count;
            }
            for (int m = 0; m < count; m++) {
                int i = members[m], ok;
                if (entry < 0) {
                    if (w->far[i] <= CONTACT_ALLOWED && w->near[i] <= CONTACT_ALLOWED) continue;
                    pair_bounds(c, e, i);
                }
                if (w->near_differs && w->near[i] != w->far[i])
                    ok = proved_near_start(c, i, inside, M_tip, t0, s.from, s.to, &since, &until);
                else
                    ok = proved(c, i, w->far[i], t0, s.from, s.to, &since, &until);
                if (!ok) {
                    remember(c, i);
                    c->hit_at = t0;
                    return 0;
                }
                leave(&h, right, i, since, until, t0);
            }
        }
        if ((h.lefts || h.rights) && 0.5 * (s.to - s.from) * most < SHORTEST_MOTION) {
            remember(c, h.list[h.lefts ? 0 : right]);
            c->hit_at = t0;
            return 0;
        }
        memmove(h.list + h.lefts, h.list + right, sizeof(int) * h.rights);
        if (h.lefts) c->span[tail++] = (span){s.from, h.until_left, used, h.lefts};
        if (h.rights) c->span[tail++] = (span){h.since_right, s.to, used + h.lefts, h.rights};
        used += h.lefts + h.rights;
    }
    return 1;
}

/* Whether all positions that differ from q by at most `away` (dof,) are free: spheres and planes separate the pairs by
   more than any of their points moves. */
static int around_free(scratch *c, const double *q, const double *away) {
    const world *w = c->w;
    curve e;
    double inside = 0, M, K, n[3];
    e.beyond = 0;
    for (int j = 0; j < w->dof; j++) {
        e.speed[j] = away[j], e.bend[j] = 0;
        e.beyond += beyond_stroke(w, j, fabs(q[j]) + away[j]);
    }
    forward(c, q);
    middles(c);
    if (w->near_differs) {
        bounds(w, &e, w->tool, 0, w->tip_lever, &M, &K);
        double left = w->contact_distance - tool_travel(c);
        inside = left > M ? 1 : left + M <= 0 ? -1 : 0; /* near for sure, far for sure */
    }
    for (int g = 0; g < w->groups; g++) {
        const group *G = &w->group[g];
        double most = inside > 0 ? G->near : inside < 0 ? G->far : fmax(G->near, G->far);
        if (most <= CONTACT_ALLOWED) continue;
        double Mb = 0, Kb = 0;
        bounds(w, &e, G->spheres.a, G->spheres.common, w->body[G->spheres.a].reach, &M, &K);
        if (G->moving && !G->spheres.fixed)
            bounds(w, &e, G->spheres.b, G->spheres.common, w->body[G->spheres.b].reach, &Mb, &Kb);
        c->checks++;
        if (group_clear(c, G, most + TOUCHING + M + Mb)) continue;
        for (int k = 0; k < G->count; k++) {
            int i = w->member[G->first + k];
            double margin = inside > 0 ? w->near[i] : inside < 0 ? w->far[i] : fmax(w->near[i], w->far[i]);
            if (margin <= CONTACT_ALLOWED) continue;
            pair_bounds(c, &e, i);
            c->checks++;
            double far = margin + TOUCHING + c->bound[i][0], need = margin + TOUCHING + c->bound[i][2];
            if (w->shape[w->pair[i].b].kind == POINTS) {
                if (pair_clear(c, i, far, need)) continue;
                return 0;
            }
            if (pair_apart(c, &w->pair[i], n) > far) continue;
            gjk_answer found;
            pair_distance(c, i, need, need, 1.0, &found);
            if (!(found.below > need)) return 0;
        }
    }
    return 1;
}

/* The first of positions (count, dof) that is not free, or -1; ranges about their middles are proved at once. */
static int first_hit(scratch *c, int count, const double *path) {
    int dof = c->w->dof, top = 0, stack[128][2];
    if (count < 1) return -1;
    stack[top][0] = 0, stack[top++][1] = count - 1;
    while (top) {
        int i = stack[--top][0], j = stack[top][1], m = i + (j - i) / 2;
        const double *q = path + (size_t)dof * m;
        if (i == j) {
            if (!state_free(c, q)) return i;
            continue;
        }
        double away[MAX_JOINTS] = {0};
        int known = 1; /* all are finite */
        for (int k = i; k <= j; k++)
            for (int d = 0; d < dof; d++) {
                double way = fabs(path[(size_t)dof * k + d] - q[d]);
                if (!(way < FARTHEST)) known = 0;
                away[d] = fmax(away[d], way);
            }
        if (known && around_free(c, q, away)) continue;
        if (j - i == 1) {
            stack[top][0] = stack[top][1] = j, top++;
            stack[top][0] = stack[top][1] = i, top++;
        } else {
            stack[top][0] = m + 1, stack[top++][1] = j;
            stack[top][0] = i, stack[top++][1] = m;
        }
    }
    return -1;
}

#endif

/* A robot among obstacles: joints, shapes, pairs that may not touch, and the working memory of one thread. */
#ifndef ZK_WORLD_H
#define ZK_WORLD_H

#include "gjk.h"

#define MOST_JOINTS 32 /* the first stands for the world */
#define EXCUSED (-1e9) /* [m] a margin that every distance keeps */
#define TOUCHING 1e-9  /* [m] shapes this close touch: what cannot be told apart from contact is contact */

enum { FIXED, REVOLUTE, PRISMATIC };

typedef struct {
    int parent, kind;
    pose place;       /* in the frame of the parent; frames are turned so that z is the axis */
    double turned[9]; /* from the turned frame to the frame that was given */
    int depth;        /* joints from the world to this one, itself included */
    int chain[MOST_JOINTS];
} joint;

typedef struct {
    int a, b;   /* shapes; the joints of a beyond `common` are at least as many as those of b */
    int common; /* the last joint that moves both */
    int fixed;  /* whether b rests in the frame of `common` */
} pair;

typedef struct {
    int dof, joints, shapes, pairs, room;
    joint joint[MOST_JOINTS]; /* joint i > 0 is moved by q[i - 1] */
    double lower[MOST_JOINTS], upper[MOST_JOINTS];
    shape *shape;
    double (*lever)[MOST_JOINTS]; /* of each shape about each joint [m]: as far from the axis as it ever gets */
    double (*reach)[MOST_JOINTS]; /* the same of the middle of its ball */
    pair *pair;
    double *far, *near; /* margins [m] of the pairs; near holds while the tool is near its start */
    int excuses;        /* whether near and far differ */
    int tool;           /* joint that carries the tool point */
    double tip[3], origin[3], leash;
    double tip_lever[MOST_JOINTS];
} world;

/* What one thread needs to answer questions. */
typedef struct {
    const world *w;
    pose T[MOST_JOINTS];
    double spin[MOST_JOINTS][3], slide[MOST_JOINTS][3]; /* twist of each joint's body: angular, linear at the origin */
    double (*middle)[3];
    pose *T_shape;
    unsigned *stamp, now;
    double (*axis)[3]; /* direction that held a pair apart the last time, frame of b */
    int *order;        /* pairs, those that touched last first */
    /* edges */
    int *list, list_room;
    struct span *span;
    int span_room;
    /* what happened */
    long states, checks, searches, iterations;
    int hit_pair;
    double hit_at;
} scratch;

static double axis_distance(const double *p) { return sqrt(p[0] * p[0] + p[1] * p[1]); }

/* Levers of a ball of radius r about a point of a joint's frame: for every joint above, the farthest that any of its
   points can be from the axis, whatever the positions of the joints between. */
static void levers_of(const world *w, int j, const double *at, double r, double *lever) {
    memset(lever, 0, sizeof(double) * MOST_JOINTS);
    if (!j) return;
    double beyond = norm3(at) + r;
    lever[j] = w->joint[j].kind == PRISMATIC ? 1.0 : axis_distance(at) + r;
    while (w->joint[j].parent) {
        double stroke = w->joint[j].kind == PRISMATIC ? fmax(fabs(w->lower[j - 1]), fabs(w->upper[j - 1])) : 0.0;
        const double *offset = w->joint[j].place.p;
        beyond += stroke;
        int up = w->joint[j].parent;
        lever[up] = w->joint[up].kind == PRISMATIC ? 1.0 : axis_distance(offset) + beyond;
        beyond += norm3(offset);
        j = up;
    }
}

/* The hull's own farthest point from the axis of the joint that carries it; for other shapes that of their ball. */
static void measure(world *w, int i) {
    shape *s = &w->shape[i];
    double at[3];
    act(&s->placed, s->middle, at);
    levers_of(w, s->joint, at, s->ball, w->lever[i]);
    levers_of(w, s->joint, at, 0.0, w->reach[i]);
    if (s->joint && s->kind == HULL) {
        double beyond = 0, most = 0;
        for (int k = 0; k < s->blocks; k++)
            for (int m = 0; m < 4; m++) {
                double p[3] = {s->x[k][m], s->y[k][m], s->z[k][m]}, out[3];
                act(&s->placed, p, out);
                beyond = fmax(beyond, norm3(out)), most = fmax(most, axis_distance(out));
            }
        double origin[3] = {0, 0, 0}, own[MOST_JOINTS];
        levers_of(w, s->joint, origin, beyond, own);
        if (w->joint[s->joint].kind != PRISMATIC) own[s->joint] = most;
        for (int k = 0; k < MOST_JOINTS; k++) w->lever[i][k] = fmin(w->lever[i][k], own[k]);
    }
}

static void forward(scratch *c, const double *q) {
    const world *w = c->w;
    for (int j = 1; j < w->joints; j++) {
        const joint *J = &w->joint[j];
        pose *T = &c->T[j];
        compose(&c->T[J->parent], &J->place, T);
        if (J->kind == REVOLUTE) {
            double s = sin(q[j - 1]), k = cos(q[j - 1]);
            for (int r = 0; r < 9; r += 3) {
                double x = T->R[r], y = T->R[r + 1];
                T->R[r] = k * x + s * y, T->R[r + 1] = k * y - s * x;
            }
        } else {
            for (int r = 0; r < 3; r++) T->p[r] += T->R[3 * r + 2] * q[j - 1];
        }
    }
    c->now++;
    c->states++;
}

/* Twists of the joints' bodies at joint velocities dq, after `forward`. */
static void twists(scratch *c, const double *dq) {
    const world *w = c->w;
    for (int j = 1; j < w->joints; j++) {
        const pose *T = &c->T[j];
        int up = w->joint[j].parent;
        double a[3] = {T->R[2], T->R[5], T->R[8]}, m[3];
        if (w->joint[j].kind == REVOLUTE) {
            cross3(T->p, a, m);
            for (int k = 0; k < 3; k++) {
                c->spin[j][k] = c->spin[up][k] + a[k] * dq[j - 1];
                c->slide[j][k] = c->slide[up][k] + m[k] * dq[j - 1];
            }
        } else {
            for (int k = 0; k < 3; k++) {
                c->spin[j][k] = c->spin[up][k];
                c->slide[j][k] = c->slide[up][k] + a[k] * dq[j - 1];
            }
        }
    }
}

static inline const pose *shape_pose(scratch *c, int i) {
    const shape *s = &c->w->shape[i];
    if (s->joint && c->stamp[i] != c->now) {
        compose(&c->T[s->joint], &s->placed, &c->T_shape[i]);
        c->stamp[i] = c->now;
    }
    return &c->T_shape[i];
}

static inline void middles(scratch *c) {
    const world *w = c->w;
    for (int i = 0; i < w->shapes; i++)
        if (w->shape[i].joint) {
            double at[3];
            act(&w->shape[i].placed, w->shape[i].middle, at);
            act(&c->T[w->shape[i].joint], at, c->middle[i]);
        }
}

/* Distance [m] of the ball about a from b, at most the pair's; n: unit, world, from a to b. */
static inline double ball_distance(scratch *c, const pair *p, double *n) {
    const world *w = c->w;
    const shape *A = &w->shape[p->a], *B = &w->shape[p->b];
    if (B->kind == HULL || B->kind == SPHERE || !p->fixed) {
        sub3(c->middle[p->b], c->middle[p->a], n);
        double far = norm3(n);
        if (far < 1e-12) {
            n[0] = n[1] = 0, n[2] = 1;
            return -A->ball - B->ball;
        }
        for (int k = 0; k < 3; k++) n[k] /= far;
        return far - A->ball - B->ball;
    }
    const pose *T = shape_pose(c, p->b);
    double d[3], at[3], m[3];
    sub3(c->middle[p->a], T->p, d);
    unrotate(T->R, d, at);
    double far = point_distance(B, at, m);
    rotate(T->R, m, n);
    return far - A->ball;
}

/* Bounds on the distance of a pair, stopping as `gjk` does; begins with the direction that served last. */
static inline void pair_distance(scratch *c, int i, double enough, double near, double share, gjk_answer *out) {
    const pair *p = &c->w->pair[i];
    pose T;
    relative(shape_pose(c, p->b), shape_pose(c, p->a), &T);
    gjk(&c->w->shape[p->a], &c->w->shape[p->b], &T, c->axis[i], enough, near, share, out);
    c->searches++, c->iterations += out->iterations;
    if (out->below > -1e9) memcpy(c->axis[i], out->n, sizeof out->n);
}

static void to_front(scratch *c, int i) {
    int k = 0;
    while (c->order[k] != i) k++;
    int to = k / 2;
    memmove(c->order + to + 1, c->order + to, sizeof(int) * (k - to));
    c->order[to] = i;
}

static inline double tool_travel(scratch *c) {
    double at[3];
    act(&c->T[c->w->tool], c->w->tip, at);
    sub3(at, c->w->origin, at);
    return norm3(at);
}

/* Whether the robot is free at q; else `hit_pair` is a pair that is not. */
static int state_free(scratch *c, const double *q) {
    const world *w = c->w;
    forward(c, q);
    middles(c);
    const double *margin = w->excuses && tool_travel(c) < w->leash ? w->near : w->far;
    for (int k = 0; k < w->pairs; k++) {
        int i = c->order[k];
        if (margin[i] <= EXCUSED) continue;
        double n[3];
        c->checks++;
        double need = margin[i] + TOUCHING;
        if (ball_distance(c, &w->pair[i], n) > need) continue;
        gjk_answer found;
        pair_distance(c, i, need, margin[i], 2.0, &found);
        if (found.below > need) continue;
        c->hit_pair = i;
        to_front(c, i);
        return 0;
    }
    return 1;
}

#endif

/* A robot among obstacles: joints, shapes, pairs to check, and the working memory of one thread. */
#ifndef ZK_WORLD_H
#define ZK_WORLD_H

#include "points.h"

#define MAX_JOINTS 32 /* the first is the world */
#define CONTACT_ALLOWED (-1e9) /* [m] a margin that every distance satisfies */
#define HOT 8
#define TOUCHING 1e-9  /* [m] shapes this close count as touching */

enum { FIXED, REVOLUTE, PRISMATIC };

typedef struct {
    int parent, kind;
    pose place;       /* in the frame of the parent; frames are turned so that z is the axis */
    double turned[9]; /* from the turned frame to the original frame */
    int depth;        /* number of joints from the world to this one, itself included */
    int chain[MAX_JOINTS];
} joint;

typedef struct {
    int a, b;   /* shapes; the joints of a beyond `common` are at least as many as those of b */
    int common; /* the last joint that moves both */
    int fixed;  /* whether b is fixed in the frame of `common` */
} pair;

/* Pairs of the shapes of one joint's body with one obstacle, or with the shapes of another body: a sphere about the body
   decides most of them at once. */
typedef struct {
    pair spheres;        /* a: the body; b: the obstacle's shape, or a body where `moving` */
    int moving;
    int first, count;  /* of `member` */
    double far, near;  /* largest margin of its pairs */
} group;

typedef struct {
    double middle[3], sphere;        /* in the frame of the joint */
    double reach[MAX_JOINTS];     /* levers of the middle */
} body;

#define MAX_CONSTRAINTS 8

/* A number n x - least that must not be negative: of a direction of the tool, or of the tool point. */
typedef struct {
    int direction;
    double at[3];  /* the direction, in the frame of the joint that carries the tool */
    double n[3], least, slack; /* slack: of n x, at the tolerance */
    double inside; /* where states are projected to: an angle [rad], or a distance from the bound [m] */
} constraint;

typedef struct {
    int dof, joints, shapes, pairs, room;
    joint joint[MAX_JOINTS]; /* joint i > 0 is moved by q[i - 1] */
    double lower[MAX_JOINTS], upper[MAX_JOINTS];
    double stroke[MAX_JOINTS]; /* [m] how far each joint slides within its limits */
    shape *shape;
    double (*lever)[MAX_JOINTS]; /* of each shape about each joint [m]: as far from the axis as it ever gets */
    double (*reach)[MAX_JOINTS]; /* the same for the centre of its sphere */
    pair *pair;
    group *group;
    int groups, *member;
    body body[MAX_JOINTS];
    double *far, *near; /* margins [m] of the pairs; near applies while the tool is near its start */
    int near_differs;        /* whether near and far differ */
    int tool;           /* joint that carries the tool point */
    double tip[3], origin[3], contact_distance;
    double tip_lever[MAX_JOINTS];
    int constraints, constrained_joint; /* number of tool constraints, and the joint that carries the tool */
    constraint constraint[MAX_CONSTRAINTS];
    double constrained_tip[3], constrained_lever[MAX_JOINTS], turn_lever[MAX_JOINTS];
} world;

/* Working memory of one thread. */
typedef struct {
    const world *w;
    pose T[MAX_JOINTS];
    double spin[MAX_JOINTS][3], slide[MAX_JOINTS][3]; /* twist of each joint's body: angular, linear at the origin */
    double (*middle)[3];
    pose *T_shape;
    unsigned *stamp, now;
    double (*axis)[3]; /* direction that separated a pair last, frame of b */
    int *touched;      /* node of a set of points that a pair touched last */
    int hot[HOT];      /* pairs that touched last, the last one first */
    double (*body_middle)[3];
    double (*bound)[4]; /* of each pair on a curve: M and K of the sphere, M and K of the shape */
    /* edges */
    int *list, list_room;
    struct span *span;
    int span_room;
    /* counters and the last hit */
    long long states, checks, searches, iterations, edges;
    int hit_pair;
    double hit_at;
} scratch;

static double axis_distance(const double *p) { return sqrt(p[0] * p[0] + p[1] * p[1]); }

/* Levers of a sphere of radius r about a point of a joint's frame: for every joint above, the largest distance of any of
   its points from the axis, over all positions within limits of the joints between. */
static void levers_of(const world *w, int j, const double *at, double r, double *lever) {
    memset(lever, 0, sizeof(double) * MAX_JOINTS);
    if (!j) return;
    double beyond = norm3(at) + r;
    lever[j] = w->joint[j].kind == PRISMATIC ? 1.0 : axis_distance(at) + r;
    while (w->joint[j].parent) {
        const double *offset = w->joint[j].place.p;
        beyond += w->stroke[j];
        int up = w->joint[j].parent;
        lever[up] = w->joint[up].kind == PRISMATIC ? 1.0 : axis_distance(offset) + beyond;
        beyond += norm3(offset);
        j = up;
    }
}

/* Levers of a shape: by the farthest point of a hull from the axis of its joint, for other shapes by their sphere. */
static void measure(world *w, int i) {
    shape *s = &w->shape[i];
    double at[3];
    act(&s->placed, s->middle, at);
    levers_of(w, s->joint, at, s->sphere, w->lever[i]);
    levers_of(w, s->joint, at, 0.0, w->reach[i]);
    if (s->joint && s->kind == HULL) {
        double beyond = 0, most = 0;
        for (int k = 0; k < s->blocks; k++)
            for (int m = 0; m < 4; m++) {
                double p[3] = {s->x[k][m], s->y[k][m], s->z[k][m]}, out[3];
                act(&s->placed, p, out);
                beyond = fmax(beyond, norm3(out)), most = fmax(most, axis_distance(out));
            }
        double origin[3] = {0, 0, 0}, own[MAX_JOINTS];
        levers_of(w, s->joint, origin, beyond, own);
        if (w->joint[s->joint].kind != PRISMATIC) own[s->joint] = most;
        for (int k = 0; k < MAX_JOINTS; k++) w->lever[i][k] = fmin(w->lever[i][k], own[k]);
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
    for (int j = 1; j < w->joints; j++)
        if (w->body[j].sphere >= 0) act(&c->T[j], w->body[j].middle, c->body_middle[j]);
    for (int i = 0; i < w->shapes; i++)
        if (w->shape[i].joint) {
            double at[3];
            act(&w->shape[i].placed, w->shape[i].middle, at);
            act(&c->T[w->shape[i].joint], at, c->middle[i]);
        }
}

/* Distance [m] of two spheres; n: unit, from the first to the second. */
static inline double spheres_apart(const double *a, double ra, const double *b, double rb, double *n) {
    sub3(b, a, n);
    double far = norm3(n);
    if (far < 1e-12) {
        n[0] = n[1] = 0, n[2] = 1;
        return -ra - rb;
    }
    for (int k = 0; k < 3; k++) n[k] /= far;
    return far - ra - rb;
}

/* Lower bound [m] of the distance of a sphere (world) and a shape; n: unit, world, from the sphere to the shape. */
static inline double sphere_apart(scratch *c, const double *middle, double sphere, int b, double *n) {
    const shape *B = &c->w->shape[b];
    if (B->kind == HULL || B->kind == SPHERE) return spheres_apart(middle, sphere, c->middle[b], B->sphere, n);
    const pose *T = shape_pose(c, b);
    double d[3], at[3], m[3];
    sub3(middle, T->p, d);
    unrotate(T->R, d, at);
    double far = point_distance(B, at, m);
    rotate(T->R, m, n);
    return far - sphere;
}

/* The same for the sphere about the first shape of a pair. A second shape that moves is replaced by its sphere, too, so
   that its rotation does not matter. */
static inline double pair_apart(scratch *c, const pair *p, double *n) {
    const world *w = c->w;
    if (!p->fixed) return spheres_apart(c->middle[p->a], w->shape[p->a].sphere, c->middle[p->b], w->shape[p->b].sphere, n);
    return sphere_apart(c, c->middle[p->a], w->shape[p->a].sphere, p->b, n);
}

static inline double group_apart(scratch *c, const group *g, double *n) {
    if (!g->spheres.a) return -INFINITY; /* neither moves: the pairs decide */
    const body *A = &c->w->body[g->spheres.a];
    const double *middle = c->body_middle[g->spheres.a];
    if (!g->moving) return sphere_apart(c, middle, A->sphere, g->spheres.b, n);
    return spheres_apart(middle, A->sphere, c->body_middle[g->spheres.b], c->w->body[g->spheres.b].sphere, n);
}

/* Bounds on the distance of a pair, stopping as `gjk` does; starts with the last successful direction. */
static inline void pair_distance(scratch *c, int i, double enough, double near, double share, gjk_answer *out) {
    const pair *p = &c->w->pair[i];
    pose T;
    relative(shape_pose(c, p->b), shape_pose(c, p->a), &T);
    gjk(&c->w->shape[p->a], &c->w->shape[p->b], &T, c->axis[i], enough, near, share, out);
    c->searches++, c->iterations += out->iterations;
    if (out->below > -1e9) memcpy(c->axis[i], out->n, sizeof out->n);
}

static void remember(scratch *c, int i) {
    int k = 0;
    while (k < HOT - 1 && c->hot[k] != i) k++;
    memmove(c->hot + 1, c->hot, sizeof(int) * k);
    c->hot[0] = c->hit_pair = i;
}

static inline double tool_travel(scratch *c) {
    double at[3];
    act(&c->T[c->w->tool], c->w->tip, at);
    sub3(at, c->w->origin, at);
    return norm3(at);
}

/* Whether the sphere about the first shape of a pair is `far` [m] from all points of the second, or the shape `need`. */
static inline int pair_clear(scratch *c, int i, double far, double need) {
    const pair *p = &c->w->pair[i];
    const shape *A = &c->w->shape[p->a];
    const struct points *set = c->w->shape[p->b].set;
    const pose *T = shape_pose(c, p->a);
    if (set && c->touched[i] >= 0 && c->touched[i] < set->nodes) { /* likely still touching */
        const sphere_node *b = &set->node[c->touched[i]];
        gjk_answer found;
        if (node_apart(c->middle[p->a], A->sphere, b) <= far) {
            node_distance(A, T, b, c->axis[i], need, need, 1.0, &found);
            if (!(found.below > need)) return 0;
        }
    }
    c->touched[i] = points_touch(set, A, T, c->middle[p->a], A->sphere, far, need, c->axis[i], &c->searches);
    return c->touched[i] < 0;
}

/* Whether the sphere about a body is farther than a distance from an obstacle. */
static inline int group_clear(scratch *c, const group *g, double need) {
    double n[3] = {0, 0, 1};
    const body *A = &c->w->body[g->spheres.a];
    if (g->moving || c->w->shape[g->spheres.b].kind != POINTS) return group_apart(c, g, n) > need;
    const double *middle = c->body_middle[g->spheres.a];
    return points_touch(c->w->shape[g->spheres.b].set, NULL, NULL, middle, A->sphere, need, need, n, &c->searches) < 0;
}

/* Whether a pair keeps its margin at the current position. */
static inline int pair_free(scratch *c, int i, double margin) {
    double n[3], need = margin + TOUCHING;
    c->checks++;
    if (c->w->shape[c->w->pair[i].b].kind == POINTS) return pair_clear(c, i, need, need);
    if (pair_apart(c, &c->w->pair[i], n) > need) return 1;
    gjk_answer found;
    pair_distance(c, i, need, margin, 1.0, &found);
    return found.below > need;
}

/* Whether the pairs that touched last keep their margins at the current position. */
static inline int hot_free(scratch *c, const double *margin) {
    for (int k = 0; k < HOT && c->hot[k] >= 0; k++)
        if (margin[c->hot[k]] > CONTACT_ALLOWED && !pair_free(c, c->hot[k], margin[c->hot[k]])) {
            remember(c, c->hot[k]);
            return 0;
        }
    return 1;
}

/* Whether the robot is free at q; else `hit_pair` is a pair that is not. */
static int state_free(scratch *c, const double *q) {
    const world *w = c->w;
    forward(c, q);
    middles(c);
    int starting = w->near_differs && tool_travel(c) < w->contact_distance;
    const double *margin = starting ? w->near : w->far;
    if (!hot_free(c, margin)) return 0;
    for (int g = 0; g < w->groups; g++) {
        const group *G = &w->group[g];
        double most = starting ? G->near : G->far;
        if (most <= CONTACT_ALLOWED) continue;
        c->checks++;
        if (group_clear(c, G, most + TOUCHING)) continue;
        for (int k = 0; k < G->count; k++) {
            int i = w->member[G->first + k];
            if (margin[i] <= CONTACT_ALLOWED || pair_free(c, i, margin[i])) continue;
            remember(c, i);
            return 0;
        }
    }
    return 1;
}

#endif

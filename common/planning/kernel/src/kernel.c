/* The functions that Python calls. None stores a pointer of the caller. Several threads may read a world at once if each
   has its own scratch; a thread may change it while no other uses it. */
#include "ik.h"
#include "speeds.h"

#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

#define VERSION 11

API int zk_version(void) { return VERSION; }

/* 1 if processor and operating system support AVX2 and FMA, for which a second library is built. */
API int zk_has_avx2(void) {
#if defined(__x86_64__)
    unsigned a, b, c, d;
    __asm__ volatile("cpuid" : "=a"(a), "=b"(b), "=c"(c), "=d"(d) : "a"(0), "c"(0));
    if (a < 7) return 0;
    __asm__ volatile("cpuid" : "=a"(a), "=b"(b), "=c"(c), "=d"(d) : "a"(1), "c"(0));
    int fma = c >> 12 & 1, saves = c >> 27 & 1;
    if (!fma || !saves) return 0;
    unsigned low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & 6) != 6) return 0;
    __asm__ volatile("cpuid" : "=a"(a), "=b"(b), "=c"(c), "=d"(d) : "a"(7), "c"(0));
    return b >> 5 & 1;
#else
    return 0;
#endif
}

static void matrix_pose(const double *m, pose *T) { /* (3, 4) row by row */
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) T->R[3 * i + j] = m[4 * i + j];
        T->p[i] = m[4 * i + 3];
    }
}

static void *aligned(size_t bytes) {
    bytes = (bytes + 63) & ~(size_t)63;
    char *raw = malloc(bytes + 64 + sizeof(void *));
    if (!raw) return NULL;
    char *at = (char *)(((size_t)(raw + sizeof(void *)) + 63) & ~(size_t)63);
    ((void **)at)[-1] = raw;
    return at;
}

static void aligned_free(void *at) {
    if (at) free(((void **)at)[-1]);
}

/* A rotation that turns z to a unit axis. */
static void turn_z(const double *axis, double *R) {
    double x[3] = {fabs(axis[0]) < 0.9 ? 1.0 : 0.0, fabs(axis[0]) < 0.9 ? 0.0 : 1.0, 0.0}, y[3];
    double along = dot3(x, axis);
    for (int k = 0; k < 3; k++) x[k] -= along * axis[k];
    double length = norm3(x);
    for (int k = 0; k < 3; k++) x[k] /= length;
    cross3(axis, x, y);
    for (int k = 0; k < 3; k++) R[3 * k] = x[k], R[3 * k + 1] = y[k], R[3 * k + 2] = axis[k];
}

/* A robot of `dof` joints: parents (0 the world, joints count from 1), kinds (1 turns, 2 slides), placements (dof, 3, 4)
   in the parents' frames, unit axes (dof, 3), limits. NULL if it is invalid. */
API world *zk_world(int dof, const int *parents, const int *kinds, const double *placements, const double *axes,
                    const double *lower, const double *upper) {
    if (dof < 1 || dof >= MAX_JOINTS) return NULL;
    world *w = calloc(1, sizeof *w);
    if (!w) return NULL;
    w->dof = dof, w->joints = dof + 1;
    for (int k = 0; k < 9; k++) w->joint[0].turned[k] = k % 4 == 0;
    for (int j = 1; j <= dof; j++) {
        joint *J = &w->joint[j];
        J->parent = parents[j - 1], J->kind = kinds[j - 1];
        if (J->parent < 0 || J->parent >= j) {
            free(w);
            return NULL;
        }
        const joint *up = &w->joint[J->parent];
        turn_z(axes + 3 * (j - 1), J->turned);
        pose given, turn = {{0}, {0}}, back = {{0}, {0}};
        matrix_pose(placements + 12 * (j - 1), &given);
        memcpy(turn.R, J->turned, sizeof turn.R);
        for (int r = 0; r < 3; r++)
            for (int k = 0; k < 3; k++) back.R[3 * r + k] = up->turned[3 * k + r];
        compose(&back, &given, &given);
        compose(&given, &turn, &J->place);
        J->depth = up->depth + 1;
        memcpy(J->chain, up->chain, sizeof J->chain);
        J->chain[J->depth - 1] = j;
        w->lower[j - 1] = lower[j - 1], w->upper[j - 1] = upper[j - 1];
        double stroke = fmax(fabs(lower[j - 1]), fabs(upper[j - 1])); /* without limits every position is beyond the stroke */
        w->stroke[j] = J->kind == PRISMATIC && stroke < 1e6 ? stroke : 0.0;
    }
    return w;
}

static void place(world *w, int i, const double *placement) {
    shape *s = &w->shape[i];
    pose given, back = {{0}, {0}};
    matrix_pose(placement, &given);
    const double *turned = w->joint[s->joint].turned;
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++) back.R[3 * r + k] = turned[3 * k + r];
    compose(&back, &given, &s->placed);
    measure(w, i);
}

/* Adds a shape to a joint's body (0: an obstacle). size: box full sides; cylinder, capsule radius and length; sphere
   radius. points (count, 3) of a hull. sphere: middle (3) and radius of a sphere about a hull. Returns its index or -1. */
API int zk_add(world *w, int kind, int jointed, const double *size, const double *points, int count, const double *sphere,
               const double *placement) {
    if (jointed < 0 || jointed >= w->joints || kind < SPHERE || kind > POINTS) return -1;
    if ((kind == HULL && count < 1) || (kind == POINTS && jointed)) return -1;
    if (w->shapes == w->room) {
        int room = w->room ? 2 * w->room : 64;
        shape *more = realloc(w->shape, sizeof(shape) * room);
        if (!more) return -1;
        w->shape = more;
        void *lever = realloc(w->lever, sizeof(*w->lever) * room);
        if (!lever) return -1;
        w->lever = lever;
        void *reach = realloc(w->reach, sizeof(*w->reach) * room);
        if (!reach) return -1;
        w->reach = reach, w->room = room;
    }
    shape *s = &w->shape[w->shapes];
    memset(s, 0, sizeof *s);
    s->kind = kind, s->joint = jointed;
    switch (kind) {
    case SPHERE:
        s->radius = s->sphere = size[0];
        break;
    case BOX:
        for (int k = 0; k < 3; k++) s->size[k] = 0.5 * size[k];
        s->sphere = norm3(s->size);
        break;
    case CYLINDER:
        s->size[0] = size[0], s->size[1] = 0.5 * size[1];
        s->sphere = sqrt(s->size[0] * s->size[0] + s->size[1] * s->size[1]);
        break;
    case CAPSULE:
        s->size[0] = s->radius = size[0], s->size[1] = 0.5 * size[1];
        s->sphere = s->size[0] + s->size[1];
        break;
    case POINTS: /* empty until zk_points */
        break;
    default:
        s->blocks = (count + 3) / 4;
        s->x = aligned(sizeof(v4) * 3 * s->blocks);
        if (!s->x) return -1;
        s->y = s->x + s->blocks, s->z = s->y + s->blocks;
        for (int k = 0; k < 4 * s->blocks; k++) {
            const double *p = points + 3 * (k < count ? k : 0);
            ((double *)s->x)[k] = p[0], ((double *)s->y)[k] = p[1], ((double *)s->z)[k] = p[2];
        }
        memcpy(s->middle, sphere, sizeof s->middle);
        s->sphere = sphere[3];
    }
    place(w, w->shapes, placement);
    return w->shapes++;
}

/* Computes a sphere about all shapes of each joint's body. */
static void enclose(world *w) {
    for (int j = 0; j < w->joints; j++) {
        body *B = &w->body[j];
        B->sphere = -1;
        for (int i = 0; i < w->shapes; i++) {
            const shape *s = &w->shape[i];
            double at[3], to[3];
            if (s->joint != j) continue;
            act(&s->placed, s->middle, at);
            if (B->sphere < 0) {
                memcpy(B->middle, at, sizeof at);
                B->sphere = s->sphere;
                continue;
            }
            sub3(at, B->middle, to);
            double far = norm3(to);
            if (far + s->sphere <= B->sphere) continue;
            if (far + B->sphere <= s->sphere) {
                memcpy(B->middle, at, sizeof at);
                B->sphere = s->sphere;
                continue;
            }
            double sphere = 0.5 * (far + s->sphere + B->sphere) * (1 + 1e-12), way = (sphere - B->sphere) / far;
            for (int k = 0; k < 3; k++) B->middle[k] += way * to[k];
            B->sphere = sphere * (1 + 1e-12);
        }
        levers_of(w, j, B->middle, 0.0, B->reach);
    }
}

/* Sets the placement (3, 4) of a shape in its joint's frame. */
API void zk_place(world *w, int i, const double *placement) {
    place(w, i, placement);
    if (w->shape[i].joint) enclose(w);
}

static pair related(const world *w, int a, int b, int joint_a, int joint_b) {
    const joint *A = &w->joint[joint_a], *B = &w->joint[joint_b];
    int common = 0;
    while (common < A->depth && common < B->depth && A->chain[common] == B->chain[common]) common++;
    int last = common ? A->chain[common - 1] : 0;
    if (A->depth < B->depth) return (pair){b, a, last, joint_a == last};
    return (pair){a, b, last, joint_b == last};
}

/* Sets the pairs to check: (count,) first and second shapes. Returns 0 if out of memory. */
API int zk_pairs(world *w, int count, const int *first, const int *second) {
    free(w->pair), free(w->far), free(w->near), free(w->group), free(w->member);
    w->pair = malloc(sizeof(pair) * (count + 1));
    w->far = calloc(count + 1, sizeof(double)), w->near = calloc(count + 1, sizeof(double));
    w->group = malloc(sizeof(group) * (count + 1)), w->member = malloc(sizeof(int) * (count + 1));
    int *owner = malloc(sizeof(int) * (count + 1));
    w->pairs = w->groups = 0;
    if (!w->pair || !w->far || !w->near || !w->group || !w->member || !owner) {
        free(owner);
        return 0;
    }
    enclose(w);
    for (int i = 0; i < count; i++) {
        w->pair[i] = related(w, first[i], second[i], w->shape[first[i]].joint, w->shape[second[i]].joint);
        int a = w->shape[w->pair[i].a].joint, b = w->shape[w->pair[i].b].joint, obstacle = w->pair[i].b;
        int g = 0, found = 0; /* fixed shapes are grouped as obstacles, except the robot's base */
        for (; g < w->groups && !found; g++)
            found = w->group[g].spheres.a == a && (b ? w->group[g].moving && w->group[g].spheres.b == b
                                                   : !w->group[g].moving && w->group[g].spheres.b == obstacle);
        if (found) {
            g--;
        } else {
            group *G = &w->group[w->groups++];
            *G = (group){related(w, a, b, a, b), b != 0, 0, 0, 0.0, 0.0};
            if (!b) G->spheres.b = obstacle;
        }
        owner[i] = g, w->group[g].count++;
    }
    for (int g = 0, at = 0; g < w->groups; g++) {
        w->group[g].first = at, at += w->group[g].count;
        w->group[g].count = 0;
    }
    for (int i = 0; i < count; i++) {
        group *G = &w->group[owner[i]];
        w->member[G->first + G->count++] = i;
    }
    free(owner);
    w->pairs = count;
    return 1;
}

/* Sets the margins [m] of the pairs, CONTACT_ALLOWED or less for none: `near` while the tool point, at `tip` (3,) in the
   frame of joint `tool`, is within `contact_distance` [m] of `origin`, else `far`. near may be NULL. */
API void zk_rules(world *w, const double *far, const double *near, int tool, const double *tip, const double *origin,
                  double contact_distance) {
    memcpy(w->far, far, sizeof(double) * w->pairs);
    memcpy(w->near, near ? near : far, sizeof(double) * w->pairs);
    for (int g = 0; g < w->groups; g++) {
        group *G = &w->group[g];
        G->far = G->near = CONTACT_ALLOWED;
        for (int k = 0; k < G->count; k++) {
            G->far = fmax(G->far, w->far[w->member[G->first + k]]);
            G->near = fmax(G->near, w->near[w->member[G->first + k]]);
        }
    }
    w->near_differs = near && memcmp(far, near, sizeof(double) * w->pairs) != 0;
    if (!w->near_differs) return;
    w->tool = tool, w->contact_distance = contact_distance;
    unrotate(w->joint[tool].turned, tip, w->tip);
    memcpy(w->origin, origin, sizeof w->origin);
    levers_of(w, tool, w->tip, 0.0, w->tip_lever);
}

/* Sets the tool constraints: `count` numbers n x - least that must not be negative, of directions `at` (count, 3) in the
   frame of joint `tool` or, where `direction` is 0, of the point `tip` in it. Returns 0 if there are too many. */
API int zk_keep(world *w, int count, int tool, const double *tip, const int *direction, const double *at, const double *n,
                const double *least, const double *slack, const double *inside) {
    w->constraints = 0;
    if (count < 0 || count > MAX_CONSTRAINTS || tool < 0 || tool >= w->joints) return 0;
    w->constrained_joint = tool;
    unrotate(w->joint[tool].turned, tip, w->constrained_tip);
    levers_of(w, tool, w->constrained_tip, 0.0, w->constrained_lever);
    for (int j = 0; j < w->joints; j++) w->turn_lever[j] = w->joint[j].kind == REVOLUTE;
    for (int i = 0; i < count; i++) {
        constraint *k = &w->constraint[i];
        k->direction = direction[i] != 0, k->least = least[i], k->slack = slack[i], k->inside = inside[i];
        unrotate(w->joint[tool].turned, at + 3 * i, k->at);
        memcpy(k->n, n + 3 * i, sizeof k->n);
    }
    w->constraints = count;
    return 1;
}

API void zk_free(world *w) {
    if (!w) return;
    for (int i = 0; i < w->shapes; i++) aligned_free(w->shape[i].x), points_free(w->shape[i].set);
    free(w->shape), free(w->lever), free(w->reach), free(w->pair), free(w->far), free(w->near);
    free(w->group), free(w->member), free(w);
}

API void zk_scratch_free(scratch *c) {
    if (!c) return;
    free(c->middle), free(c->T_shape), free(c->stamp), free(c->axis), free(c->list), free(c->span);
    free(c->body_middle), free(c->bound), free(c->touched), free(c);
}

/* Working memory for one thread; create it again after adding shapes or pairs. */
API scratch *zk_scratch(const world *w) {
    scratch *c = calloc(1, sizeof *c);
    if (!c) return NULL;
    c->w = w;
    c->middle = calloc(w->shapes + 1, sizeof *c->middle);
    c->T_shape = calloc(w->shapes + 1, sizeof *c->T_shape);
    c->stamp = calloc(w->shapes + 1, sizeof *c->stamp);
    c->axis = calloc(w->pairs + 1, sizeof *c->axis);
    c->body_middle = calloc(w->joints, sizeof *c->body_middle);
    c->bound = calloc(w->pairs + 1, sizeof *c->bound);
    c->touched = calloc(w->pairs + 1, sizeof *c->touched);
    if (!c->middle || !c->T_shape || !c->stamp || !c->axis || !c->body_middle || !c->bound || !c->touched) {
        zk_scratch_free(c);
        return NULL;
    }
    for (int k = 0; k < 3; k++) c->T[0].R[4 * k] = 1.0;
    for (int i = 0; i < w->pairs; i++) c->axis[i][2] = 1.0, c->touched[i] = -1;
    for (int k = 0; k < HOT; k++) c->hot[k] = -1;
    return c;
}

/* Applies the current placements of obstacles: after zk_place, before the next query. */
API void zk_refresh(scratch *c) {
    const world *w = c->w;
    for (int i = 0; i < w->shapes; i++)
        if (!w->shape[i].joint) {
            c->T_shape[i] = w->shape[i].placed;
            act(&c->T_shape[i], w->shape[i].middle, c->middle[i]);
        }
    c->now++;
}

/* Replaces the spheres (count, 4), centre and radius [m], world, of a shape of kind POINTS; call zk_refresh afterwards.
   Returns 0 if out of memory. */
API int zk_points(world *w, int i, int count, const double *spheres) {
    shape *s = &w->shape[i];
    struct points *set = points_of(count, spheres);
    if (!set) return 0;
    points_free(s->set);
    s->set = set;
    memset(s->middle, 0, sizeof s->middle);
    if (count) memcpy(s->middle, set->node[0].c, sizeof s->middle);
    s->sphere = count ? set->node[0].r : 0.0;
    return 1;
}

/* See downsample_points. */
API int zk_thin(int count, const double *points, const uint8_t *skip, double side, double *out) {
    return downsample_points(count, points, skip, side, (double(*)[4])out);
}

/* Sets a 1 in `out` (count,) for each of points (count, 3), world, within a margin [m] of any shape with the robot at q.
   margins: of each shape, CONTACT_ALLOWED for those to ignore. */
API void zk_near(scratch *c, const double *q, const double *margins, int count, const double *points, uint8_t *out) {
    const world *w = c->w;
    double reach[MAX_JOINTS], axis[3] = {0, 0, 1}; /* squares of the distances within which bodies are checked */
    forward(c, q);
    middles(c);
    for (int j = 0; j < w->joints; j++) reach[j] = -1;
    for (int i = 0; i < w->shapes; i++) {
        int j = w->shape[i].joint;
        double far = w->body[j].sphere + margins[i];
        if (j && margins[i] > CONTACT_ALLOWED) reach[j] = fmax(reach[j], far * far);
    }
    for (int k = 0; k < count; k++) {
        const double *at = points + 3 * (size_t)k;
        double d[3], n[3];
        unsigned near = 1; /* joints whose bodies are near; obstacles are checked one by one */
        for (int j = 1; j < w->joints; j++) {
            sub3(at, c->body_middle[j], d);
            if (dot3(d, d) <= reach[j]) near |= 1u << j;
        }
        for (int i = 0; i < w->shapes && !out[k]; i++) {
            const shape *B = &w->shape[i];
            double margin = margins[i], far = B->sphere + margin;
            if (margin <= CONTACT_ALLOWED || B->kind == POINTS || !(near >> B->joint & 1)) continue;
            sub3(at, c->middle[i], d);
            if (dot3(d, d) > far * far) continue;
            const pose *T = shape_pose(c, i);
            if (B->kind == HULL) {
                sphere_node point = {{at[0], at[1], at[2]}, 0.0, 0};
                gjk_answer found;
                node_distance(B, T, &point, axis, margin, margin, 1.0, &found);
                if (found.below > -1e9) memcpy(axis, found.n, sizeof axis);
                out[k] = !(found.below > margin);
            } else {
                sub3(at, T->p, d);
                unrotate(T->R, d, d);
                out[k] = point_distance(B, d, n) <= margin;
            }
        }
    }
}

/* -1 if the robot is free at q, else a pair that is too close. */
API int zk_state(scratch *c, const double *q) { return state_free(c, q) ? -1 : c->hit_pair; }

/* -1 if the complete straight line in joint space is proved free; else a pair, and where on it (0 to 1). */
API int zk_edge(scratch *c, const double *a, const double *b, double *at) {
    curve e;
    line_curve(c->w, a, b, &e);
    if (curve_free(c, &e)) return -1;
    *at = c->hit_at;
    return c->hit_pair;
}

/* The same for the cubics q(t) = c0 + c1 t + c2 t^2 + c3 t^3, 0 <= t <= 1, one after the other: (count, 4, dof). */
API int zk_cubics(scratch *c, int count, const double *coefficients, double *at) {
    curve e;
    for (int i = 0; i < count; i++) {
        cubic_curve(c->w, coefficients + 4 * c->w->dof * i, &e);
        if (!curve_free(c, &e)) {
            *at = i + c->hit_at;
            return c->hit_pair;
        }
    }
    return -1;
}

/* The first of cubics (count, 4, dof), as in zk_cubics, that violates a tool constraint, -1 if none, and where on it.
   States may use the share `accepted` of the slack; the share `proved` is proved between them. */
API int zk_kept(scratch *c, int count, const double *coefficients, double accepted, double proved, double *at) {
    curve e;
    for (int i = 0; i < count; i++) {
        cubic_curve(c->w, coefficients + 4 * c->w->dof * i, &e);
        if (!curve_satisfies(c, &e, accepted, proved)) {
            *at = c->hit_at;
            return i;
        }
    }
    return -1;
}

/* The first of positions (count, dof) that is not free, -1 if all are; `hit` is a pair that is too close there. */
API int zk_first(scratch *c, int count, const double *path, int *hit) {
    int found = first_hit(c, count, path);
    *hit = c->hit_pair;
    return found;
}

/* Bounds (pairs,) [m] on the distances at q: of two points, and of a separating plane. */
API void zk_distances(scratch *c, const double *q, double *above, double *below) {
    forward(c, q);
    middles(c);
    for (int i = 0; i < c->w->pairs; i++) {
        gjk_answer found;
        const pair *p = &c->w->pair[i];
        if (c->w->shape[p->b].kind == POINTS) {
            const shape *A = &c->w->shape[p->a];
            points_distance(c->w->shape[p->b].set, A, shape_pose(c, p->a), c->middle[p->a], c->axis[i], above + i, below + i);
            continue;
        }
        pair_distance(c, i, INFINITY, -INFINITY, 1.0, &found);
        above[i] = found.above, below[i] = found.below;
    }
}

/* Poses (joints, 3, 4) of the joints' original frames. */
API void zk_forward(scratch *c, const double *q, double *out) {
    forward(c, q);
    for (int j = 1; j < c->w->joints; j++) {
        pose back = {{0}, {0}}, T;
        const double *turned = c->w->joint[j].turned;
        for (int r = 0; r < 3; r++)
            for (int k = 0; k < 3; k++) back.R[3 * r + k] = turned[3 * k + r];
        compose(&c->T[j], &back, &T);
        for (int r = 0; r < 3; r++) {
            for (int k = 0; k < 3; k++) out[12 * (j - 1) + 4 * r + k] = T.R[3 * r + k];
            out[12 * (j - 1) + 4 * r + 3] = T.p[r];
        }
    }
}

/* Counters: states, checks of pairs, GJK searches, their iterations, edges. */
API void zk_counters(const scratch *c, long long *out) {
    out[0] = c->states, out[1] = c->checks, out[2] = c->searches, out[3] = c->iterations;
    out[4] = c->edges;
}

/* Waypoints (room, dof) of a free path from the start to one of goals (goals, dof), all free: their number, or -1 for too
   many nodes, -2 out of time, -3 cancelled, -4 no room. `cancel` may be NULL, or set by another thread. */
API int zk_plan(scratch *c, const double *start, int goals, const double *goal, const plan_options *options,
                const volatile int *cancel, int room, double *path, plan_report *report) {
    memset(report, 0, sizeof *report);
    run r = {c, options, cancel, now() + options->seconds};
    return plan(&r, start, goals, goal, room, path, report);
}

/* See speeds.h. */
API int zk_speeds(int count, int rows, const double *lengths, const double *up, const double *down, const double *slope,
                  double *highest, double *x, double *u) {
    return speeds(count, rows, lengths, up, down, slope, highest, x, u);
}

/* Finds joint positions with a tool, at `tip` (3, 4) in the frame of joint `tool`, at a target (3, 4). q (dof,) is the seed
   and the result. Returns the number of random starts, -1 if nothing was found. tolerance: [m], [rad]. Reads only joints
   and limits of the world. */
API int zk_ik(const world *w, int tool, const double *tip, const double *tolerance, const double *target, int restarts,
              int steps, uint64_t seed, double *q) {
    arm a = {w, w->joint[tool].depth, w->joint[tool].chain, {{0}, {0}}, tolerance[0], tolerance[1]};
    pose turned = {{0}, {0}}, given, to;
    rng random;
    memcpy(turned.R, w->joint[tool].turned, sizeof turned.R);
    matrix_pose(tip, &given);
    relative(&turned, &given, &a.tip);
    matrix_pose(target, &to);
    seed_random(&random, seed);
    return reach(&a, &to, restarts, steps, &random, q);
}

/* A path among obstacles: RRT-Connect (Kuffner, LaValle 2000), then shortcuts. All edges are proved free. The seed decides
   the path. With tool constraints, new states are projected onto them (Berenson et al. 2009, see constraints.h). */
#ifndef ZK_PLANNER_H
#define ZK_PLANNER_H

#include <stdint.h>
#include <time.h>

#include "constraints.h"

typedef struct {
    uint64_t s[4];
} rng; /* xoshiro256++ of Blackman and Vigna */

static inline uint64_t rotl(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

static inline uint64_t next_random(rng *r) {
    uint64_t *s = r->s, out = rotl(s[0] + s[3], 23) + s[0], t = s[1] << 17;
    s[2] ^= s[0], s[3] ^= s[1], s[1] ^= s[2], s[0] ^= s[3], s[2] ^= t, s[3] = rotl(s[3], 45);
    return out;
}

static inline double uniform(rng *r) { return (double)(next_random(r) >> 11) * 0x1p-53; }

static void seed_random(rng *r, uint64_t seed) { /* splitmix64 */
    for (int k = 0; k < 4; k++) {
        uint64_t z = (seed += 0x9e3779b97f4a7c15u);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u, z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        r->s[k] = z ^ (z >> 31);
    }
}

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

typedef struct {
    int count, room, dof;
    double *q;
    int *parent;
} tree;

static int add_node(tree *t, const double *q, int parent) {
    if (t->count == t->room) {
        int room = t->room ? 2 * t->room : 256;
        double *more = realloc(t->q, sizeof(double) * t->dof * room);
        if (more) t->q = more;
        int *parents = realloc(t->parent, sizeof(int) * room);
        if (parents) t->parent = parents;
        if (!more || !parents) return -1;
        t->room = room;
    }
    memcpy(t->q + (size_t)t->dof * t->count, q, sizeof(double) * t->dof);
    t->parent[t->count] = parent;
    return t->count++;
}

static void free_tree(tree *t) { free(t->q), free(t->parent); }

static double distance2(int dof, const double *a, const double *b) {
    double sum = 0;
    for (int j = 0; j < dof; j++) sum += (a[j] - b[j]) * (a[j] - b[j]);
    return sum;
}

static int nearest(const tree *t, const double *q, double *square) {
    int best = 0;
    double least = INFINITY;
    for (int i = 0; i < t->count; i++) {
        double d = distance2(t->dof, t->q + (size_t)t->dof * i, q);
        if (d < least) least = d, best = i;
    }
    *square = least;
    return best;
}

static int line_free(scratch *c, const double *a, const double *b) {
    curve e;
    if (!line_satisfies(c, a, b)) return 0;
    line_curve(c->w, a, b, &e);
    return curve_free(c, &e);
}

typedef struct {
    double range;        /* [rad] longest edge of the trees */
    double seconds;      /* wall time for the search and the shortcuts together */
    long long nodes;     /* limit of both trees */
    long long shortcuts; /* limit of attempts */
    long long patience;  /* failed shortcuts in a row that end the shortening */
    uint64_t seed;
} plan_options;

typedef struct {
    long long samples, nodes, from_start, shortcuts, shortened; /* from_start: nodes of the start's tree */
    double search_seconds, shorten_seconds;
} plan_report;

enum { NO_PATH = -1, NO_TIME = -2, CANCELLED = -3, NO_MEMORY = -4 };

typedef struct {
    scratch *c;
    const plan_options *o;
    const volatile int *cancel;
    double end;
} run;

static int stopped(const run *r) {
    if (r->cancel && *r->cancel) return CANCELLED;
    return now() >= r->end ? NO_TIME : 0;
}

#define SHORTEST_STEP 0.02 /* [rad] of the trees, with tool constraints */
#define LEAST_PROGRESS 0.1 /* share of a step that must reduce the distance */

/* Sets a state `to` towards q that satisfies the constraints, with a free line from a; 0 if none. Longest step first. */
static int step_towards(run *r, const double *a, const double *q, double far, double *to, int *reached) {
    scratch *c = r->c;
    int dof = c->w->dof;
    for (double step = fmin(r->o->range, far); step >= fmin(SHORTEST_STEP, far) && step > 0; step *= 0.5) {
        *reached = step >= far;
        for (int j = 0; j < dof; j++) to[j] = *reached ? q[j] : a[j] + step / far * (q[j] - a[j]);
        if (!state_satisfies(c, to)) {
            *reached = 0;
            if (!project(c, to)) continue;
        }
        if (!*reached && sqrt(distance2(dof, to, q)) > far - LEAST_PROGRESS * step) continue;
        if (!line_satisfies(c, a, to)) continue;
        return state_free(c, to) && line_free(c, a, to);
    }
    return 0;
}

/* Adds a node towards q from the nearest one; returns its index, or -1. */
static int extend(run *r, tree *t, int from, const double *q, double square, int *reached) {
    int dof = t->dof;
    double far = sqrt(square), to[MAX_JOINTS];
    const double *a = t->q + (size_t)dof * from;
    if (r->c->w->constraints) return step_towards(r, a, q, far, to, reached) ? add_node(t, to, from) : -1;
    *reached = far <= r->o->range;
    double share = *reached ? 1.0 : r->o->range / far;
    for (int j = 0; j < dof; j++) to[j] = *reached ? q[j] : a[j] + share * (q[j] - a[j]);
    if (!state_free(r->c, to) || !line_free(r->c, a, to)) return -1;
    return add_node(t, to, from);
}

/* Sets the nodes at which both trees meet; returns 0 or an error. */
static int search(run *r, tree trees[2], int meet[2], rng *random, plan_report *report) {
    const world *w = r->c->w;
    int dof = w->dof, grows = 0;
    double q[MAX_JOINTS], square;
    while (trees[0].count + trees[1].count < r->o->nodes) {
        int stop = stopped(r);
        if (stop) return stop;
        tree *one = &trees[grows], *other = &trees[1 - grows];
        report->samples++;
        for (int j = 0; j < dof; j++) q[j] = w->lower[j] + uniform(random) * (w->upper[j] - w->lower[j]);
        if (w->constraints) project(r->c, q);
        int from = nearest(one, q, &square);
        int reached, node = extend(r, one, from, q, square, &reached);
        if (node < 0) continue;
        memcpy(q, one->q + (size_t)dof * node, sizeof(double) * dof);
        int at = nearest(other, q, &square);
        for (;;) {
            stop = stopped(r);
            if (stop) return stop;
            if (trees[0].count + trees[1].count >= r->o->nodes) return NO_PATH;
            int next = extend(r, other, at, q, square, &reached);
            if (next < 0) break;
            at = next;
            if (reached) {
                meet[grows] = node, meet[1 - grows] = at;
                return 0;
            }
            square = distance2(dof, other->q + (size_t)dof * at, q);
        }
        if (trees[grows].count > trees[1 - grows].count) grows = 1 - grows; /* the smaller tree grows */
    }
    return NO_PATH;
}

static double path_length(int dof, int count, const double *path) {
    double sum = 0;
    for (int i = 0; i + 1 < count; i++) sum += sqrt(distance2(dof, path + (size_t)dof * i, path + (size_t)dof * (i + 1)));
    return sum;
}

/* Drops waypoints by free lines from each waypoint to the farthest reachable one. */
static int skip_waypoints(run *r, int count, double *path) {
    int dof = r->c->w->dof;
    for (int i = 0; i + 2 < count; i++)
        for (int j = count - 1; j > i + 1; j--) {
            if (stopped(r)) return count;
            if (!line_free(r->c, path + (size_t)dof * i, path + (size_t)dof * j)) continue;
            memmove(path + (size_t)dof * (i + 1), path + (size_t)dof * j, sizeof(double) * dof * (count - j));
            count -= j - i - 1;
            break;
        }
    return count;
}

#define MAX_FOLLOWED 64

/* Waypoints from a to b, both included: a straight line, or steps that satisfy the constraints; 0 if not free. */
static int follow(run *r, const double *a, const double *b, double *out) {
    int dof = r->c->w->dof, count = 1, reached = 0;
    memcpy(out, a, sizeof(double) * dof);
    if (line_free(r->c, a, b)) {
        memcpy(out + dof, b, sizeof(double) * dof);
        return 2;
    }
    if (!r->c->w->constraints) return 0;
    for (; count < MAX_FOLLOWED && !reached; count++) {
        double *at = out + (size_t)dof * (count - 1), far = sqrt(distance2(dof, at, b));
        if (stopped(r) || !step_towards(r, at, b, far, at + dof, &reached)) return 0;
    }
    return reached ? count : 0;
}

/* Replaces pieces between two points of the path by free straight lines, or by steps close to them. */
static int shorten(run *r, int count, int room, double *path, rng *random, plan_report *report) {
    int dof = r->c->w->dof;
    long long failed = 0;
    for (long long k = 0; k < r->o->shortcuts && failed < r->o->patience && count > 2; k++) {
        if (stopped(r)) break;
        report->shortcuts++;
        double total = path_length(dof, count, path);
        double s = uniform(random) * total, t = uniform(random) * total;
        if (s > t) {
            double swap = s;
            s = t, t = swap;
        }
        double ends[2][MAX_JOINTS], at[2] = {s, t}, sum = 0;
        int piece[2] = {-1, -1};
        for (int i = 0; i + 1 < count; i++) {
            const double *a = path + (size_t)dof * i, *b = a + dof;
            double length = sqrt(distance2(dof, a, b));
            for (int m = 0; m < 2; m++)
                if (piece[m] < 0 && (at[m] <= sum + length || i + 2 == count)) {
                    double share = length > 0 ? fmin(fmax((at[m] - sum) / length, 0.0), 1.0) : 0.0;
                    piece[m] = i;
                    for (int j = 0; j < dof; j++) ends[m][j] = a[j] + share * (b[j] - a[j]);
                }
            sum += length;
        }
        if (piece[0] == piece[1]) continue;
        int dropped = piece[1] - piece[0]; /* waypoints between the two points */
        double before = 0, *first = path + (size_t)dof * (piece[0] + 1);
        before += sqrt(distance2(dof, ends[0], first)) + sqrt(distance2(dof, ends[1], path + (size_t)dof * piece[1]));
        before += path_length(dof, dropped, first);
        double after = sqrt(distance2(dof, ends[0], ends[1])), new[MAX_FOLLOWED * MAX_JOINTS];
        int added = after > before - 1e-3 * total ? 0 : follow(r, ends[0], ends[1], new);
        if (!added || count - dropped + added > room || path_length(dof, added, new) > before - 1e-3 * total) {
            failed++;
            continue;
        }
        failed = 0;
        report->shortened++;
        memmove(first + added * (size_t)dof, first + (size_t)dof * dropped, sizeof(double) * dof * (count - piece[1] - 1));
        memcpy(first, new, sizeof(double) * dof * added);
        count += added - dropped;
    }
    return count;
}

/* Waypoints of a path from the start to one of the goals, in `path` with room for `room`: their number or an error. */
static int plan(run *r, const double *start, int goals, const double *goal, int room, double *path, plan_report *report) {
    int dof = r->c->w->dof, meet[2], count = 0;
    double began = now();
    tree trees[2] = {{.dof = dof}, {.dof = dof}};
    rng random;
    seed_random(&random, r->o->seed);
    int error = goals < 1 ? NO_PATH : add_node(&trees[0], start, -1) < 0 ? NO_MEMORY : 0;
    for (int g = 0; g < goals && !error; g++)
        if (add_node(&trees[1], goal + (size_t)dof * g, -1) < 0) error = NO_MEMORY;
    if (!error) error = search(r, trees, meet, &random, report);
    report->nodes = trees[0].count + trees[1].count, report->from_start = trees[0].count;
    report->search_seconds = now() - began;
    if (!error) {
        int steps = 0;
        for (int i = meet[0]; i >= 0; i = trees[0].parent[i]) steps++;
        for (int i = trees[1].parent[meet[1]]; i >= 0; i = trees[1].parent[i]) count++;
        if (steps + count > room) {
            error = NO_MEMORY;
        } else {
            int k = steps;
            for (int i = meet[0]; i >= 0; i = trees[0].parent[i])
                memcpy(path + (size_t)dof * --k, trees[0].q + (size_t)dof * i, sizeof(double) * dof);
            k = steps;
            for (int i = trees[1].parent[meet[1]]; i >= 0; i = trees[1].parent[i])
                memcpy(path + (size_t)dof * k++, trees[1].q + (size_t)dof * i, sizeof(double) * dof);
            count = k;
        }
    }
    free_tree(&trees[0]), free_tree(&trees[1]);
    if (error) return error;
    began = now();
    if (r->o->shortcuts > 0) {
        count = skip_waypoints(r, count, path);
        count = shorten(r, count, room, path, &random, report);
        count = skip_waypoints(r, count, path);
    }
    report->shorten_seconds = now() - began;
    return count;
}

#endif

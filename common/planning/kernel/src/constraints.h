/* Tool constraints: numbers n x - least, of a direction fixed to the tool or of the tool point, that must not be negative.
   Along a curve they are bounded as distances are in edges.h. States that violate one are projected: steps by the
   pseudo-inverse of the Jacobian, after Berenson, Srinivasa, Ferguson, Kuffner, "Manipulation planning on constraint
   manifolds" (ICRA 2009). */
#ifndef ZK_CONSTRAINTS_H
#define ZK_CONSTRAINTS_H

#include "edges.h"

#define MAX_EVALUATIONS 20000    /* on one curve; what is not proved then counts as a violation */
#define MAX_PROJECTIONS 30 /* steps */
#define LONGEST_PROJECTION 0.5 /* [rad], [m] in one joint and step */

/* Shares of the slack that states may use, and that are proved between them: PLANNING_SHARES in constraints.py. */
#define STATE_SHARE 0.25
#define LINE_SHARE 0.5

/* x of a constraint after `forward`, world. */
static inline void constrained_point(const scratch *c, const constraint *k, double *x) {
    const pose *T = &c->T[c->w->constrained_joint];
    if (k->direction)
        rotate(T->R, k->at, x);
    else
        act(T, c->w->constrained_tip, x);
}

static inline double constraint_value(const scratch *c, const constraint *k) {
    double x[3];
    constrained_point(c, k, x);
    return dot3(k->n, x) - k->least;
}

static int state_satisfies(scratch *c, const double *q) {
    const world *w = c->w;
    if (!w->constraints) return 1;
    forward(c, q);
    for (int i = 0; i < w->constraints; i++)
        if (!(constraint_value(c, &w->constraint[i]) >= -STATE_SHARE * w->constraint[i].slack)) return 0;
    return 1;
}

/* Whether a curve satisfies all constraints up to shares of the slack; else `hit_at` is where it does not. */
static int curve_satisfies(scratch *c, const curve *e, double accepted, double proved) {
    const world *w = c->w;
    double M[2], K[2], q[MAX_JOINTS], dq[MAX_JOINTS], t = 0;
    bounds(w, e, w->constrained_joint, 0, w->constrained_lever, &M[0], &K[0]);
    bounds(w, e, w->constrained_joint, 0, w->turn_lever, &M[1], &K[1]);
    for (int n = 0; n < MAX_EVALUATIONS; n++) {
        double step = INFINITY;
        c->hit_at = t;
        at_time(w, e, t, q, dq);
        forward(c, q);
        twists(c, dq);
        for (int i = 0; i < w->constraints; i++) {
            const constraint *k = &w->constraint[i];
            double x[3], dx[3];
            constrained_point(c, k, x);
            double s = dot3(k->n, x) - k->least;
            if (!(s >= -accepted * k->slack)) return 0;
            cross3(c->spin[w->constrained_joint], x, dx);
            if (!k->direction)
                for (int m = 0; m < 3; m++) dx[m] += c->slide[w->constrained_joint][m];
            step = fmin(step, time_to_zero(s + proved * k->slack, -dot3(k->n, dx), K[k->direction], M[k->direction]));
        }
        t += step;
        if (t >= 1) return 1;
    }
    return 0;
}

static int line_satisfies(scratch *c, const double *a, const double *b) {
    curve e;
    if (!c->w->constraints) return 1;
    line_curve(c->w, a, b, &e);
    return curve_satisfies(c, &e, STATE_SHARE, LINE_SHARE);
}

/* Returns whether a constraint is violated, and sets the distance [rad], [m] to where it is projected to, a little inside
   its bound, and the change of the constraint by one unit of each joint. */
static int violation(const scratch *c, const constraint *k, double *left, double *row) {
    const world *w = c->w;
    const joint *J = &w->joint[w->constrained_joint];
    double x[3], s, sine = 1;
    constrained_point(c, k, x);
    s = dot3(k->n, x) - k->least;
    if (s >= 0) return 0;
    *left = k->inside - s;
    if (k->direction) { /* by the angle, not by its cosine */
        double m[3];
        cross3(k->n, x, m);
        sine = fmax(norm3(m), 1e-6);
        *left = atan2(sine, dot3(k->n, x)) - k->inside;
    }
    for (int j = 0; j < w->dof; j++) row[j] = 0;
    for (int i = 0; i < J->depth; i++) {
        int j = J->chain[i];
        const pose *T = &c->T[j];
        double axis[3] = {T->R[2], T->R[5], T->R[8]}, arm[3], dx[3];
        if (w->joint[j].kind == REVOLUTE) {
            memcpy(arm, x, sizeof arm);
            if (!k->direction) sub3(x, T->p, arm);
            cross3(axis, arm, dx);
        } else {
            for (int m = 0; m < 3; m++) dx[m] = k->direction ? 0 : axis[m];
        }
        row[j - 1] = dot3(k->n, dx) / sine;
    }
    return 1;
}

/* Moves q, within the limits, to where all constraints are satisfied; 0 if it gets stuck. */
static int project(scratch *c, double *q) {
    const world *w = c->w;
    double J[MAX_CONSTRAINTS][MAX_JOINTS], A[MAX_CONSTRAINTS][MAX_CONSTRAINTS], x[MAX_CONSTRAINTS];
    for (int n = 0; n < MAX_PROJECTIONS; n++) {
        int rows = 0;
        forward(c, q);
        for (int i = 0; i < w->constraints; i++) rows += violation(c, &w->constraint[i], &x[rows], J[rows]);
        if (!rows) return 1;
        for (int r = 0; r < rows; r++) { /* (J J' + damping) x = left, by Cholesky's factors */
            for (int k = 0; k <= r; k++) {
                A[r][k] = r == k ? 1e-6 : 0;
                for (int j = 0; j < w->dof; j++) A[r][k] += J[r][j] * J[k][j];
            }
            for (int k = 0; k < r; k++) {
                for (int m = 0; m < k; m++) A[r][k] -= A[r][m] * A[k][m];
                A[r][k] *= A[k][k];
                A[r][r] -= A[r][k] * A[r][k];
                x[r] -= A[r][k] * x[k];
            }
            A[r][r] = 1 / sqrt(fmax(A[r][r], 1e-12));
            x[r] *= A[r][r];
        }
        double step[MAX_JOINTS], most = 0;
        for (int r = rows - 1; r >= 0; r--) {
            for (int k = r + 1; k < rows; k++) x[r] -= A[k][r] * x[k];
            x[r] *= A[r][r];
        }
        for (int j = 0; j < w->dof; j++) {
            step[j] = 0;
            for (int r = 0; r < rows; r++) step[j] += J[r][j] * x[r];
            most = fmax(most, fabs(step[j]));
        }
        if (!(most < 1e6)) return 0;
        double share = most > LONGEST_PROJECTION ? LONGEST_PROJECTION / most : 1.0;
        for (int j = 0; j < w->dof; j++) q[j] = fmin(fmax(q[j] + share * step[j], w->lower[j]), w->upper[j]);
    }
    return 0;
}

#endif

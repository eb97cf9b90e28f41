/* Inverse kinematics: damped least squares within the limits, from a seed and then from random starts. */
#ifndef ZK_IK_H
#define ZK_IK_H

#include "planner.h"

#define LARGEST_STEP 1.0 /* [rad], [m] in one joint and iteration: beyond it the linearisation means nothing */
#define FULL_TURN 6.283185307179586 /* [rad] */
#define MAX_STEPS 50 /* from a random start */

typedef struct {
    const world *w;
    int joints;       /* of the chain that carries the tool */
    const int *chain;
    pose tip;         /* of the tool in the frame of the chain's last joint */
    double position, rotation; /* tolerances [m], [rad] */
} arm;

/* Rotation vector [rad] of a rotation, by its quaternion: exact near 0 and near half a turn. */
static void rotation_vector(const double *R, double *out) {
    double t[4] = {R[0] + R[4] + R[8], R[0] - R[4] - R[8], R[4] - R[0] - R[8], R[8] - R[0] - R[4]};
    double v[3] = {R[7] - R[5], R[2] - R[6], R[3] - R[1]}, w = 1 + t[0];
    int most = 0;
    for (int k = 1; k < 4; k++)
        if (t[k] > t[most]) most = k;
    if (most) {
        int i = most - 1, j = most % 3, k = (most + 1) % 3;
        w = v[i];
        v[i] = 1 + t[most], v[j] = R[3 * i + j] + R[3 * j + i], v[k] = R[3 * i + k] + R[3 * k + i];
    }
    if (w < 0) w = -w, v[0] = -v[0], v[1] = -v[1], v[2] = -v[2];
    double sine = norm3(v), scale = sine > 1e-12 * w ? 2 * atan2(sine, w) / sine : 2 / w;
    for (int k = 0; k < 3; k++) out[k] = scale * v[k];
}

/* Returns whether q is within the tolerances, and sets the twist (6,) from q to the target, linear at the tool point
   first, world, and the Jacobian of the chain's joints. */
static int tool_error(const arm *a, const double *q, const pose *target, double *error, double (*J)[6]) {
    pose T = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}};
    double at[MAX_JOINTS][3];
    for (int i = 0; i < a->joints; i++) {
        const joint *joint = &a->w->joint[a->chain[i]];
        double value = q[a->chain[i] - 1];
        compose(&T, &joint->place, &T);
        double axis[3] = {T.R[2], T.R[5], T.R[8]};
        if (joint->kind == REVOLUTE) {
            double s = sin(value), k = cos(value);
            for (int r = 0; r < 9; r += 3) {
                double x = T.R[r], y = T.R[r + 1];
                T.R[r] = k * x + s * y, T.R[r + 1] = k * y - s * x;
            }
            memcpy(J[i] + 3, axis, sizeof axis);
            memcpy(at[i], T.p, sizeof T.p);
        } else {
            for (int r = 0; r < 3; r++) T.p[r] += axis[r] * value;
            memcpy(J[i], axis, sizeof axis);
            J[i][3] = J[i][4] = J[i][5] = 0;
        }
    }
    compose(&T, &a->tip, &T);
    for (int i = 0; i < a->joints; i++)
        if (a->w->joint[a->chain[i]].kind == REVOLUTE) {
            double lever[3];
            sub3(T.p, at[i], lever);
            cross3(J[i] + 3, lever, J[i]);
        }
    pose left;
    relative(&T, target, &left);
    rotation_vector(left.R, error + 3);
    rotate(T.R, error + 3, error + 3);
    sub3(target->p, T.p, error);
    return dot3(error, error) < a->position * a->position && dot3(error + 3, error + 3) < a->rotation * a->rotation;
}

/* step = J' (J J' + damping)^-1 error of the joints that are not left out, by a Cholesky decomposition; no joint moves
   more than LARGEST_STEP. */
static void damped_step(const arm *a, double (*J)[6], const int *left_out, const double *error, double damping,
                        double *step) {
    double A[6][6], x[6], most = 0;
    for (int r = 0; r < 6; r++)
        for (int c = 0; c <= r; c++) A[r][c] = r == c ? damping : 0;
    for (int i = 0; i < a->joints; i++)
        if (!left_out[i])
            for (int r = 0; r < 6; r++)
                for (int c = 0; c <= r; c++) A[r][c] += J[i][r] * J[i][c];
    for (int r = 0; r < 6; r++) {
        x[r] = error[r];
        for (int c = 0; c < r; c++) {
            for (int k = 0; k < c; k++) A[r][c] -= A[r][k] * A[c][k];
            A[r][c] *= A[c][c];
            A[r][r] -= A[r][c] * A[r][c];
            x[r] -= A[r][c] * x[c];
        }
        A[r][r] = 1 / sqrt(fmax(A[r][r], 1e-12)); /* stores its inverse */
        x[r] *= A[r][r];
    }
    for (int r = 5; r >= 0; r--) {
        for (int k = r + 1; k < 6; k++) x[r] -= A[k][r] * x[k];
        x[r] *= A[r][r];
    }
    for (int i = 0; i < a->joints; i++) {
        step[i] = 0;
        if (!left_out[i])
            for (int r = 0; r < 6; r++) step[i] += J[i][r] * x[r];
        most = fmax(most, fabs(step[i]));
    }
    if (most > LARGEST_STEP)
        for (int i = 0; i < a->joints; i++) step[i] *= LARGEST_STEP / most;
}

/* Whether a joint can be turned back by a full turn at either limit; descriptions round limits to few digits. */
static int turns_round(const world *w, int j) {
    return w->joint[j].kind == REVOLUTE && w->upper[j - 1] - w->lower[j - 1] >= FULL_TURN - 1e-3;
}

/* Moves q, within the limits, to where the tool is at the target; 0 if it gets stuck. The damping follows the error
   (Sugihara 2011). A joint that presses against a limit is left out of the step. With `anywhere` it is turned back by a
   full turn if possible, and the search ends when five steps do not halve the square of the error. */
static int converge(const arm *a, const pose *target, int steps, int anywhere, double *q) {
    const world *w = a->w;
    double J[MAX_JOINTS][6], error[6], step[MAX_JOINTS], last = INFINITY;
    for (int n = 0; n < steps; n++) {
        if (tool_error(a, q, target, error, J)) return 1;
        double size = dot3(error, error) + dot3(error + 3, error + 3);
        if (anywhere && n % 5 == 0) {
            if (!(size < 0.5 * last)) return 0;
            last = size;
        }
        int left_out[MAX_JOINTS] = {0};
        for (int tries = 0, blocked = 1; blocked && tries < 3; tries++) {
            blocked = 0;
            damped_step(a, J, left_out, error, 0.05 * fmin(1.0, size) + 1e-7, step);
            for (int i = 0; i < a->joints; i++) {
                int j = a->chain[i];
                double at = q[j - 1], low = w->lower[j - 1], high = w->upper[j - 1];
                if (left_out[i] || (anywhere && turns_round(w, j))) continue;
                if ((at <= low && at + step[i] < low) || (at >= high && at + step[i] > high)) {
                    left_out[i] = blocked = 1;
                    step[i] = 0;
                }
            }
        }
        for (int i = 0; i < a->joints; i++) {
            int j = a->chain[i];
            double to = q[j - 1] + step[i], low = w->lower[j - 1], high = w->upper[j - 1];
            if (anywhere && turns_round(w, j)) to += to > high ? -FULL_TURN : to < low ? FULL_TURN : 0;
            q[j - 1] = fmin(fmax(to, low), high);
        }
    }
    return 0;
}

/* Finds joint positions q with the tool at the target: from the seed in q, then from random starts. Returns the number of
   random starts used, -1 if none led there. */
static int reach(const arm *a, const pose *target, int restarts, int steps, rng *random, double *q) {
    const world *w = a->w;
    for (int j = 0; j < w->dof; j++) q[j] = fmin(fmax(q[j], w->lower[j]), w->upper[j]);
    if (converge(a, target, steps, 0, q)) return 0;
    for (int n = 1; n <= restarts; n++) {
        for (int i = 0; i < a->joints; i++) {
            int j = a->chain[i] - 1;
            q[j] = w->lower[j] + uniform(random) * (w->upper[j] - w->lower[j]);
        }
        if (converge(a, target, MAX_STEPS, 1, q)) return n;
    }
    return -1;
}

#endif

/* The closed-loop kernel of fdhil/model/closed_loop_kernels.py, line by line but step by step, for comparison under -O3. */
#include <math.h>
#include <stddef.h>

static double low(double a, double b) { return a < b ? a : b; }
static double high(double a, double b) { return a > b ? a : b; }

void p_pi_pi(const double *reference, long n, long first, long rows, const double *p, const double *g, const double *t,
             long n_terms, long n_speed, long n_current, double *state, double *out)
{
    const double kv = g[0], kff = g[1], speed_kp = g[2], speed_ki = g[3], current_max = g[4];
    const double current_kp = g[5], current_ki = g[6], voltage_max = g[7], period = g[8], half_step_mm = g[9];
    double i = state[0], w = state[1], x = state[2], speed_integral = state[3], current_integral = state[4], demand_a = state[5];
    for (long row = 0; row < rows; row++) {
        long k = first + row, last = n - 1;
        double r0 = reference[k < last ? k : last];
        double r1 = reference[k + 1 < last ? k + 1 : last];
        double r2 = reference[k + 2 < last ? k + 2 : last];
        double rise = r1 - r0, slope = rise / period, bend = (r2 - r1) / period - slope;
        long limited = 0;
        double *o = out + row;
        o[rows] = i; o[2 * rows] = w; o[3 * rows] = x;
        o[4 * rows] = speed_integral; o[5 * rows] = current_integral; o[6 * rows] = demand_a;
        for (long m = 0; m < n_speed; m++) {
            double part = (double)m / (double)n_speed;
            double demand = kv * (r0 + rise * part - x) + kff * (slope + bend * part);
            double error = demand - w;
            double candidate = speed_integral + speed_ki * error;
            double raw = speed_kp * error + candidate;
            demand_a = low(high(raw, -current_max), current_max);
            int current_limited = demand_a != raw;
            if (!current_limited) speed_integral = candidate;
            if (n_terms > 0) {
                for (long c = 0; c < n_current; c++) {
                    error = demand_a - i;
                    candidate = current_integral + current_ki * error;
                    raw = current_kp * error + candidate;
                    double u = low(high(raw, -voltage_max), voltage_max);
                    if (u == raw) {
                        current_integral = candidate;
                        if (current_limited) limited++;
                    } else limited++;
                    if (t[8] != 0.0) u -= t[8] * low(high(i / g[16], -1.0), 1.0);
                    double against = t[0] + ((w > 0.0 ? t[4] : t[5]) - t[3]) * w, angle = g[13] * (x + half_step_mm * w);
                    for (long r = 11; r < n_terms; r += 3) against += t[r + 1] * sin(t[r] * angle + t[r + 2]);
                    double push = p[14] * i - against;
                    double side = (w > 0.0 || (w == 0.0 && push > 0.0)) ? 1.0 : -1.0;
                    double dry = side > 0.0 ? t[1] : t[2];
                    if (t[6] != 0.0 && fabs(w) <= 6.0 * t[7]) dry += t[6] * exp(-(w / t[7]) * (w / t[7]));
                    if (w == 0.0 && fabs(push) <= dry) { i = p[12] * i + p[13] * u; continue; }
                    double torque = -against - side * dry;
                    double w_next = p[2] * i + p[3] * w + p[7] * u + p[10] * torque;
                    if (w_next * side < 0.0) {
                        x += half_step_mm * w;
                        w_next = 0.0;
                    } else x += p[4] * i + p[5] * w + p[8] * u + p[11] * torque;
                    i = p[0] * i + p[1] * w + p[6] * u + p[9] * torque;
                    w = w_next;
                }
                continue;
            }
            for (long c = 0; c < n_current; c++) {
                error = demand_a - i;
                candidate = current_integral + current_ki * error;
                raw = current_kp * error + candidate;
                double u = low(high(raw, -voltage_max), voltage_max);
                if (u == raw) {
                    current_integral = candidate;
                    if (current_limited) limited++;
                } else limited++;
                double torque = p[14] * i;
                if (w == 0.0 && fabs(torque) <= p[15]) { i = p[12] * i + p[13] * u; continue; }
                double friction = (w > 0.0 || (w == 0.0 && torque > 0.0)) ? -p[15] : p[15];
                double w_next = p[2] * i + p[3] * w + p[7] * u + p[10] * friction;
                if (w_next * friction > 0.0) {
                    x += half_step_mm * w;
                    i = p[0] * i + p[1] * w + p[6] * u + p[9] * friction;
                    w = 0.0;
                } else {
                    x += p[4] * i + p[5] * w + p[8] * u + p[11] * friction;
                    i = p[0] * i + p[1] * w + p[6] * u + p[9] * friction;
                    w = w_next;
                }
            }
        }
        o[0] = (double)limited;
    }
    state[0] = i; state[1] = w; state[2] = x; state[3] = speed_integral; state[4] = current_integral; state[5] = demand_a;
}

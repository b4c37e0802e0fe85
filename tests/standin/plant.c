#include "plant.h"

#include <math.h>

/* Tables I and II of the paper, in SI. */
static const double MASS_KG = 0.05;
static const double DAMPING_N_S_PER_M = 570.0;
static const double STIFFNESS_N_PER_M = 9680.0;
static const double REST_LENGTH_M = 0.200;
static const double BRAID_LENGTH_M = 0.232;
static const double BRAID_TURNS = 1.94;
static const double FRICTION_AREA_M = 55.3 * 100.0 * 0.233e-6;
static const double TANK_PA = 441.3e3;
static const double ATMOSPHERE_PA = 101.3e3;
static const double SPECIFIC_ENERGY_J_PER_KG = 287.1 * 273.0;
static const double GAMMA = 1.4;
static const double VALVE_GAIN_M2_PER_V = 1.03e-6;

static const double LONGEST_STEP_S = 0.5e-3;

/* Forces frozen at one position and pressure; friction is a band [0, upper] (Eq. 5). */
typedef struct {
    double drive_n;
    double upper_n;
    double damping_up_n_s_per_m;
} Forces;

static double volume_scale(void)
{
    return 1.0 / (4.0 * M_PI * BRAID_TURNS * BRAID_TURNS);
}

static double volume_m3(double position_m)
{
    double length = REST_LENGTH_M - position_m;
    return length * (BRAID_LENGTH_M * BRAID_LENGTH_M - length * length) * volume_scale();
}

static Forces forces_at(double position_m, double pressure_pa)
{
    double length = REST_LENGTH_M - position_m;
    double gauge_pa = pressure_pa - ATMOSPHERE_PA;
    double grip = gauge_pa > 0.0 ? FRICTION_AREA_M * gauge_pa : 0.0;
    double area_m2 =
        (3.0 * length * length - BRAID_LENGTH_M * BRAID_LENGTH_M) * volume_scale();
    double lever_m = length * acos(length / BRAID_LENGTH_M);
    return (Forces){gauge_pa * area_m2 - STIFFNESS_N_PER_M * position_m, grip * lever_m,
                    DAMPING_N_S_PER_M + grip};
}

/* --- pressure (Eq. 7 and 8) --- */

static double orifice_flow(double upstream_pa, double downstream_pa)
{
    double critical = pow(2.0 / (GAMMA + 1.0), GAMMA / (GAMMA - 1.0));
    double scale = sqrt(2.0 * GAMMA / ((GAMMA - 1.0) * SPECIFIC_ENERGY_J_PER_KG));
    double ratio = fmax(downstream_pa / upstream_pa, critical); /* choked below */
    double throat = pow(ratio, 1.0 / GAMMA);
    double drop = 1.0 - ratio / throat;
    return drop > 0.0 ? scale * upstream_pa * throat * sqrt(drop) : 0.0;
}

static double source_pa(double opening_v)
{
    return opening_v > 0.0 ? TANK_PA : ATMOSPHERE_PA;
}

static double inflow_kg_per_s(double opening_v, double pressure_pa)
{
    double source = source_pa(opening_v), area_m2 = VALVE_GAIN_M2_PER_V * fabs(opening_v);
    return source >= pressure_pa ? area_m2 * orifice_flow(source, pressure_pa)
                                 : -area_m2 * orifice_flow(pressure_pa, source);
}

/* The flow reaches zero in finite time; an explicit step would jump across and chatter. */
static double not_past_source(double opening_v, double pressure_pa, double next_pa)
{
    double source = source_pa(opening_v);
    int jumped = (pressure_pa - source) * (next_pa - source) < 0.0;
    return opening_v != 0.0 && jumped ? source : next_pa;
}

static double filled_pa(double opening_v, double flow_pa, double energy_j, double volume,
                        double step_s)
{
    double inflow = SPECIFIC_ENERGY_J_PER_KG * inflow_kg_per_s(opening_v, flow_pa);
    return not_past_source(opening_v, flow_pa, (energy_j + step_s * inflow) / volume);
}

/* --- motion (Eq. 6): an exponential, exact under frozen forces, through stop and reversal --- */

static double terminal_of(Forces f, double direction, double *damping)
{
    *damping = direction > 0.0 ? f.damping_up_n_s_per_m : DAMPING_N_S_PER_M;
    return (f.drive_n - (direction > 0.0 ? f.upper_n : 0.0)) / *damping;
}

static void leave_rest(Plant *plant, Forces f, double step_s)
{
    plant->velocity_m_per_s = 0.0;
    if (0.0 <= f.drive_n && f.drive_n <= f.upper_n)
        return;
    double damping, terminal = terminal_of(f, f.drive_n > f.upper_n ? 1.0 : -1.0, &damping);
    double rate = damping / MASS_KG, growth = 1.0 - exp(-rate * step_s);
    plant->position_m += terminal * (step_s - growth / rate);
    plant->velocity_m_per_s = terminal * growth;
}

static void slide(Plant *plant, Forces f, double step_s)
{
    double v = plant->velocity_m_per_s;
    if (v == 0.0) {
        leave_rest(plant, f, step_s);
        return;
    }
    double damping, terminal = terminal_of(f, v, &damping);
    double rate = damping / MASS_KG, excess = v - terminal, decay = exp(-rate * step_s);
    double end_v = terminal + excess * decay;
    if (end_v != 0.0 && (end_v > 0.0) == (v > 0.0)) { /* their product would underflow */
        plant->position_m += terminal * step_s + excess * (1.0 - decay) / rate;
        plant->velocity_m_per_s = end_v;
        return;
    }
    double stop_s = terminal != 0.0 ? fmin(log(excess / -terminal) / rate, step_s) : step_s;
    plant->position_m += terminal * stop_s + v / rate;
    leave_rest(plant, f, step_s - stop_s);
}

static void plant_step(Plant *plant, double opening_v, double step_s)
{
    double before_pa = plant->pressure_pa, begin_m = plant->position_m;
    double middle_m = begin_m + 0.5 * step_s * plant->velocity_m_per_s;
    double energy_j = before_pa * volume_m3(begin_m);
    double middle_pa =
        filled_pa(opening_v, before_pa, energy_j, volume_m3(middle_m), 0.5 * step_s);
    slide(plant, forces_at(middle_m, middle_pa), step_s);
    int arrived = opening_v != 0.0 && middle_pa == source_pa(opening_v);
    plant->pressure_pa =
        arrived ? middle_pa
                : filled_pa(opening_v, middle_pa, energy_j, volume_m3(plant->position_m), step_s);
}

void plant_advance(Plant *plant, double command_v, double duration_s)
{
    double steps = fmax(1.0, ceil(duration_s / LONGEST_STEP_S - 1e-6));
    for (int i = 0; i < steps; i++)
        plant_step(plant, command_v, duration_s / steps);
}

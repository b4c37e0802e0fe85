/* The paper's muscle and valve, Eq. 1 to 9: pamctl/plant told once more, for the other side
   of the wires. A test holds the two together. */
#pragma once

typedef struct {
    double position_m;
    double velocity_m_per_s;
    double pressure_pa;
} Plant;

/* Let time pass under a constant valve command (V), in equal steps of at most 0.5 ms. */
void plant_advance(Plant *plant, double command_v, double duration_s);

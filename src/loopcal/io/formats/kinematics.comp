component {name} {title};
description """
Install it:
.nf
    sudo halcompile --install {name}.comp
.fi
In the INI file, with lengths in {unit}:
.nf
{ini}
.fi
In a HAL file, to change a parameter without compiling:
.nf
    setp {name}.{example} ...
.fi
""";
license "Apache-2.0";
option singleton yes;
include "kinematics.h";
{pins}
;;
#define KINEMATICS_WORK static /* real-time threads have small stacks */
{code}

static const double JOINT_UNIT[KINEMATICS_READINGS] = {joint_units};
static const double AXIS_UNIT[KINEMATICS_COORDINATES] = {axis_units};
static kinematics_state state;
static int is_begun;

/* Take the pins; parameters are computed again only where one of them changed. */
static void update(void)
{{
#if KINEMATICS_PARAMETERS > 0
    struct __comp_state *__comp_inst = __comp_first_inst; /* whose pins these are */
    static double known[KINEMATICS_PARAMETERS];
    const double now[KINEMATICS_PARAMETERS] = {{
{values}
    }};
    int i, is_new = !is_begun;
    for (i = 0; i < KINEMATICS_PARAMETERS; i++) {{
        is_new |= known[i] != now[i];
        known[i] = now[i];
    }}
    if (is_new)
        kinematics_set_parameters(now);
#endif
    if (!is_begun)
        kinematics_home(&state);
    is_begun = 1;
}}

KINEMATICS_TYPE kinematicsType(void)
{{
    return KINEMATICS_BOTH;
}}

int kinematicsForward(const double *joint, struct EmcPose *world,
                      const KINEMATICS_FORWARD_FLAGS *fflags, KINEMATICS_INVERSE_FLAGS *iflags)
{{
    double readings[KINEMATICS_READINGS], pose[12], c[KINEMATICS_COORDINATES];
    int i;
    (void)fflags;
    (void)iflags;
    update();
    for (i = 0; i < KINEMATICS_READINGS; i++)
        readings[i] = joint[i] * JOINT_UNIT[i];
    if (kinematics_forward(readings, &state, pose) != KINEMATICS_OK)
        return -1;
    kinematics_coordinates(pose, c);
{to_world}
    return 0;
}}

int kinematicsInverse(const struct EmcPose *world, double *joint,
                      const KINEMATICS_INVERSE_FLAGS *iflags, KINEMATICS_FORWARD_FLAGS *fflags)
{{
    double readings[KINEMATICS_READINGS], c[KINEMATICS_COORDINATES];
    int i;
    (void)fflags;
    (void)iflags;
    update();
{from_world}
    if (kinematics_inverse(c, &state, readings) != KINEMATICS_OK)
        return -1;
    for (i = 0; i < KINEMATICS_READINGS; i++)
        joint[i] = readings[i] / JOINT_UNIT[i];
    return 0;
}}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);

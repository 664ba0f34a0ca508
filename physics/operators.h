/* Inside physics/: operators on the tape, as rules for one item of a batch. operators.c turns a
 * rule into a primitive: shapes, leading dimensions, quaternions. operator_rules.c has the
 * rules. */
#ifndef PHYSICS_OPERATORS_H
#define PHYSICS_OPERATORS_H

#include "kinegrad/correction.h"
#include "kinegrad/dynamics_operators.h"
#include "kinegrad/primitive.h"

enum { KG_RULE_OPERANDS = 6 };

/* What an operand or result is made of; the shared ones have no leading dimensions. */
typedef enum kg_rule_size {
  KG_RULE_NONE,
  KG_RULE_STATE,  /* (nq): always operand 0 */
  KG_RULE_RATE,   /* (nv)             */
  KG_RULE_JOINTS, /* (n, 3)           */
  KG_RULE_POINTS, /* (point_count, 3) */
  KG_RULE_BOTH,   /* (nq + nv)        */
  KG_RULE_ONE,    /* (1)              */
  KG_RULE_LAW,    /* (6), shared      */
  KG_RULE_MASSES, /* (n), shared      */
  KG_RULE_OFFSETS /* (n, 3), shared   */
} kg_rule_size;

/* One item. in[0] is q with unit quaternions. bars are NULL where not wanted; bar[0] is by the
 * tangent of q. A rule that has an operand left out sees NULL in `in` and `bar`. */
typedef struct kg_rule_item {
  kg_dynamics_operators *operators;
  const double *in[KG_RULE_OPERANDS];
  double *out;
  double *saved; /* one number */
  const double *out_bar;
  double *bar[KG_RULE_OPERANDS];
} kg_rule_item;

typedef struct kg_rule {
  const char *name;
  kg_rule_size operands[KG_RULE_OPERANDS], result;
  kg_status (*forward)(const kg_rule_item *item);
  kg_status (*vjp)(const kg_rule_item *item); /* adds */
} kg_rule;

typedef enum kg_rule_name {
  KG_RULE_INVERSE,
  KG_RULE_FORWARD,
  KG_RULE_POSITIONS,
  KG_RULE_VELOCITIES,
  KG_RULE_ACCELERATIONS,
  KG_RULE_POINT_POSITIONS,
  KG_RULE_POINT_FORCES,
  KG_RULE_CONTACT_FORCES,
  KG_RULE_STEP,
  KG_RULE_COLLISION,
  KG_RULE_CORRECTION,
  KG_RULE_COUNT
} kg_rule_name;

extern const kg_rule kg_rules[KG_RULE_COUNT];

/* A rule with the operands it is used with: bit k set, operand k is there. */
typedef struct kg_rule_use {
  kg_dynamics_operators *operators;
  const kg_rule *rule;
  unsigned present;
} kg_rule_use;

enum { KG_RULE_MAX_USES = KG_RULE_COUNT + 8 };

struct kg_dynamics_operators {
  kg_body *body;   /* masses and offsets of a call are written into it */
  kg_body *source; /* what stands when a call brings none              */
  bool changed;    /* the body holds a call's numbers                  */
  kg_scene scene;
  kg_contact_params law;
  kg_step *step;
  kg_dynamics *dynamics;
  kg_correction *correction; /* of `source` */
  double dt;
  double *q, *q_bar; /* nq, nv: of the item               */
  double *end_bar;   /* nv: adjoint of q', tangent        */
  kg_vec3 *x, *u;    /* point_count: scratch of the rules */
  kg_rule_use uses[KG_RULE_MAX_USES];
  kg_primitive primitives[KG_RULE_MAX_USES];
  int use_count;
  kg_arena arena;
};

#endif

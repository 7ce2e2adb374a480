# SPDX-License-Identifier: Apache-2.0
"""Chains of stages: each stage is a mechanism whose base is the platform of another stage.

The pose of the end platform is the product of the mounts and poses of the stages that carry it,
its derivatives are those of the stages, transported to the end. The functions of
`loopcal.mechanism` that every robot has call these modules where a robot has stages, and hand over
the function that solves a single stage. Derivation: docs/theory/stages.md.
"""

"""Configuration: conversion of YAML into one frozen `Config`."""

from fishd.config.configuration import (
    FILE_VARIABLE,
    SERVICE_FILE,
    Config,
    Start,
    adopt,
    check_tethered,
    json_schema,
    keys,
    load,
    service_file,
    to_yaml,
)
from fishd.hardware.settings import ServoSettings as ServoSettings

__all__ = [
    "FILE_VARIABLE",
    "SERVICE_FILE",
    "Config",
    "Start",
    "adopt",
    "check_tethered",
    "json_schema",
    "keys",
    "load",
    "service_file",
    "to_yaml",
]

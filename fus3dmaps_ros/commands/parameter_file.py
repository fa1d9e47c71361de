"""The commented parameter file ``config/fus3dmaps.yaml``, generated from the schema.

``python -m fus3dmaps_ros.commands.parameter_file > config/fus3dmaps.yaml`` writes it anew.
"""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_core.config.section import bounds, choices


def yaml_with_comments(config: Config) -> str:
    """Return a ROS parameter file with every value of a configuration, each under its description and bounds."""
    lines = ["# Parameters of the fus3dmaps node. All of them, with their default values.", "/**:", "  ros__parameters:"]
    values, described = config.flat(), fields()
    for section, holder in Config.model_fields.items():
        if not isinstance(holder.default, BaseModel):
            raise TypeError(f"section '{section}' is not a model")
        lines += ["", f"    # {(type(holder.default).__doc__ or '').strip()}", f"    {section}:"]
        for name in type(holder.default).model_fields:
            key = f"{section}.{name}"
            allowed = _bounds(described[key])
            lines.append(f"      # {described[key].description}" + (f" [{allowed}]" if allowed else ""))
            lines.append(f"      {name}: {_scalar(values[key])}")
    return "\n".join(lines) + "\n"


def _bounds(field: FieldInfo) -> str:
    return " | ".join(choices(field)) or ", ".join(f"{sign} {limit}" for sign, limit in bounds(field).items())


def _scalar(value: Any) -> str:
    """Return a value as JSON, which is YAML and keeps the decimal point by which ROS tells a double from an integer."""
    return json.dumps(value, ensure_ascii=False)


if __name__ == "__main__":
    print(yaml_with_comments(Config()), end="")

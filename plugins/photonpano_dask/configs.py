"""Keys of the plugin."""

from __future__ import annotations

from pydantic import Field, field_validator, model_validator

from photonpano import Config


class DaskConfig(Config):
    """Keys of `dask`."""

    address: str | None = Field(
        None, description="address of a scheduler, such as tcp://host:8786; without it, workers are started on this machine"
    )
    workers: int | None = Field(
        None, ge=1, le=1024, description="number of workers to start on this machine; one for each thread of the run by default"
    )

    @field_validator("address", mode="after")
    @classmethod
    def _has_scheme(cls, address: str | None) -> str | None:
        if address is not None and "://" not in address:
            raise ValueError(f"expected an address such as tcp://host:8786, got {address!r}")
        return address

    @model_validator(mode="after")
    def _either(self) -> DaskConfig:
        if self.address is not None and self.workers is not None:
            raise ValueError("workers are started on this machine, and the scheduler at the address has its own; remove one")
        return self

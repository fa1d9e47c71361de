"""The services that answer: ``~/query_text``, ``~/query_image``, ``~/label_map`` and ``~/list_instances``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node

from fus3dmaps_core.answers.labels import DEFAULT_LABEL_LAYER, label_voxels
from fus3dmaps_core.answers.query import (
    DEFAULT_LAYER,
    IMAGE_PROMPT,
    QueryAnswer,
    TextQuery,
    answer_image_query,
    answer_query,
    embed_image,
)
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.messages.images import decode_color
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_msgs.srv import LabelMap, ListInstances, QueryImage, QueryText
from fus3dmaps_ros.node.session import Session, SessionHolder
from fus3dmaps_ros.node.timed_calls import between_frames
from fus3dmaps_ros.services.serving import Call, ServiceGroup
from fus3dmaps_ros.topics import conversions
from fus3dmaps_ros.topics.outputs import Outputs


class QueryServices(ServiceGroup):
    """Answers questions while mapping goes on, without changing the map."""

    def __init__(self, node: Node, sessions: SessionHolder, outputs: Outputs, read: Callable[[], Config]) -> None:
        """Offer the services.

        Args:
            node: Owner of the services.
            sessions: Has the map and the encoders.
            outputs: Publishes answers.
            read: Returns the current configuration.
        """
        super().__init__(node, read)
        self._sessions = sessions
        self._outputs = outputs
        self._offer(QueryText, "query_text", self._query_text)
        self._offer(QueryImage, "query_image", self._query_image)
        self._offer(LabelMap, "label_map", self._label_map)
        self._offer(ListInstances, "list_instances", self._list_instances)

    def _query_text(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        query, pipeline = self._to_query(request, list(request.prompts)), session.pipeline
        scale = pipeline.trio.logit_scale
        return self._answer(
            request, response, call, session, lambda mapped: answer_query(mapped, session.text, query, scale)
        )

    def _query_image(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        query, pipeline = self._to_query(request, [IMAGE_PROMPT]), session.pipeline
        rgb = decode_color(request.image, "image")
        # In the mapping thread: the encoder need not be thread-safe, and a second one might not fit on the GPU.
        crop = pipeline.trio.crop
        encoded = session.worker.between_frames(lambda: embed_image(crop, rgb), changes=False)
        embedding = call.in_time(lambda: between_frames(encoded, call.deadline))
        return self._answer(
            request,
            response,
            call,
            session,
            lambda mapped: answer_image_query(mapped, embedding, session.text, query, pipeline.trio.logit_scale),
        )

    def _label_map(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        labels, layer = list(request.labels), request.layer or DEFAULT_LABEL_LAYER
        header = self._outputs.header()
        semantic_map = session.pipeline.semantic_map
        found = call.in_time(lambda: label_voxels(semantic_map, session.text, labels, layer))
        response.cloud = conversions.to_label_cloud(header, found)
        if request.publish:
            self._outputs.publish_labels(response.cloud)
        return f"{len(found.points_m)} voxels of layer '{found.layer}' have one of {len(labels)} labels"

    def _list_instances(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        min_voxels = request.min_voxels or self._read().query.min_voxels
        header = self._outputs.header()
        instances = call.in_time(session.pipeline.semantic_map.instances)
        response.instances = conversions.to_instances(header, instances, min_voxels)
        return f"{len(response.instances)} of {len(instances.ids)} instances occupy at least {min_voxels} voxels"

    def _to_query(self, request: Any, prompts: Sequence[str]) -> TextQuery:
        """Read a checked query from a request: a threshold of 0 leaves nothing out, a top_k of 0 takes ``query.top_k``."""
        settings = self._read().query
        query = TextQuery(
            prompts,
            tuple(request.negative_prompts),
            request.layer or DEFAULT_LAYER,
            None if request.threshold == 0.0 else request.threshold,
            request.top_k or settings.top_k,
            settings.min_voxels,
        )
        query.check()
        return query

    def _answer(
        self, request: Any, response: Any, call: Call, session: Session, find: Callable[[SemanticMap], QueryAnswer]
    ) -> str:
        """Find the answer in the map of this moment, fill it into the response, and publish it if the request says so."""
        # Before the map is read, so that its content may be newer than the stamp but never older.
        header = self._outputs.header()
        # Before the call waits for its turn, when another map may be loaded.
        semantic_map = session.pipeline.semantic_map
        found = call.in_time(lambda: find(semantic_map))
        response.instances = [conversions.to_instance(header, instance) for instance in found.instances]
        response.similarity = conversions.to_similarity_cloud(header, found)
        if request.publish:
            self._outputs.publish_answer(response.similarity, response.instances)
        return f"{len(found.instances)} instances and {len(found.points_m)} voxels of layer '{found.layer}'"
